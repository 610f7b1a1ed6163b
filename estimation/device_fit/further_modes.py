"""Further modes of the structure in the signal of a sensor of motion, which the drive excites beside the mirror's own.

An accelerometer weighs a mode with the square of its frequency, so it shows every mode in the band of the drive, and
all modes below the band as a part of the drive itself. Their sum is linear and is fitted before the selection: no
effect of the catalogue is several modes, and effects of the mirror's own mode would only be seen beside them. In the
signals of other sensors the mirror's own mode is the largest, and what a nonlinear one leaves may resemble modes.
There, modes are sought where neither laws nor free corrections explain the misfit.

Source: Ewins, Modal Testing, Research Studies Press (2000), section 4.3 (modes and residual terms).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimation.device_fit.data import Output, Run, sense_channel
from estimation.device_fit.open_loop import is_worse, open_loop
from scanner.arrays import Array
from scanner.device import Axis, Device
from scanner.integrator.nodes import nodes_to_samples
from scanner.stages import Acceleration, MotionSensor
from scanner.terms.driven_modes import EFFECT, mode_response
from scanner.terms.term import MIN_MODE_QUALITY

MIN_FURTHER_MODES = 2
"""Least number of further modes that are stated before laws are selected. A single one is left to ``second-mode``, and
a direct part of the drive to ``feedthrough``."""

MAX_FURTHER_MODES = 8
"""Bound on the search. A band with more modes has a residual that the diagnosis then reports."""

MIN_GAIN = 0.05
"""Share of the remaining power in the band that a mode has to take. Less is what a nonlinear mode leaves."""

MAX_RESIDUAL_RATIO = 0.3
"""Residual over signal in the band, as standard deviations, up to which linear modes describe a structure."""

DRIVEN_POWER = 0.01
"""Power of the drive relative to its median in the driven band above which a frequency belongs to that band."""

MIN_BAND_OCTAVES = 1.0
"""Width of the drive's band that further modes need to be distinguished from a single one."""

OWN_WIDTHS = 2.0
"""Distance of a further mode from the mirror's own one in half-power widths of that. A nonlinear mode seems split."""

QUALITIES = (15.0, 50.0, 150.0)
"""Quality factors with which the band is searched for a mode."""

GRID = 60
"""Frequencies at which it is searched."""

MAX_QUALITY = 1e3
"""Largest quality factor of a further mode. A larger one is a line, not a mode."""

FIT_STEPS = 6
"""Steps of every fit of all modes; more change the misfit by less than a thousandth."""

CACHE_SIZE = 400
"""Responses that are kept. A Jacobian changes one mode at a time and needs those of the others again."""


@dataclass(frozen=True)
class _Band:
    """One channel in the band of its drive.

    Attributes:
        output: the channel.
        voltage: of the drive at the integration grid, shape (n,) [V].
        step: of the grid [s].
        order: time derivative of the motion that the channel holds.
        bins: of the Hann-windowed Fourier transform of the channel.
        data: the channel in them, shape (bins,).
        low, high: ends of the band [Hz].
    """

    output: Output
    voltage: Array
    step: float
    order: int
    bins: NDArray[np.intp]
    data: Array
    low: float
    high: float

    def transform(self, signal: Array) -> Array:
        """A signal on the integration grid, in the band."""
        return _transform(self.output.sampled(signal))[self.bins]

    def driven(self, frequency: float, quality: float) -> Array:
        """Motion of a mode of unit gain, and of one driven by the voltage's rate, as sensed, shape (bins, 2)."""
        motion = mode_response(self.voltage, frequency, quality, self.step)[self.order : self.order + 2]
        return np.array([self.transform(motion[0]), self.transform(motion[1] / (2.0 * np.pi * frequency))]).T

    def decay(self, frequency: float, quality: float) -> Array:
        """Free decay of a mode in two phases, shape (bins, 2)."""
        time = 2.0 * np.pi * frequency * self.step * np.arange(self.voltage.size)
        decay = np.exp((-0.5 / quality + 1j * np.sqrt(max(1.0 - 0.25 / quality**2, 0.0))) * time)
        return np.array([self.transform(decay.real), self.transform(decay.imag)]).T


def _transform(values: Array) -> Array:
    return np.asarray(np.fft.rfft(np.hanning(values.size) * (values - values.mean())))


def with_driven_modes(runs: Sequence[Run], device: Device, unexplained: bool = False) -> Device:
    """The device with the further modes that its sensors show, as ``[x.terms.driven-modes]``.

    It is the same one if there are none, or if it would predict worse with them.

    Args:
        unexplained: whether laws have been selected and leave most of the misfit. Then a single mode is stated too, and
            every sensor of motion is searched, not accelerometers alone.
    """
    sensor = MotionSensor if unexplained else Acceleration
    for name, axis in device.axes.items():
        may_show = _has_linear_drive(axis) and isinstance(axis.readout, sensor) and EFFECT not in axis.terms
        if may_show and (table := find_modes(runs, axis, single=unexplained)) is not None:
            extended = device.with_terms({name: {EFFECT: table}})
            if not is_worse(open_loop(runs, device), open_loop(runs, extended)):
                device = extended
    return device


def describe_modes(runs: Sequence[Run], nominal: Device, device: Device) -> dict[str, dict[str, Any]]:
    """Frequencies, quality factors and share of the further modes that ``device`` states beyond ``nominal``, by axis.

    The share is the fraction of the nominal device's misfit that they take, open loop, in the axis's sense signal.
    """
    described = {}
    for name, axis in device.axes.items():
        if EFFECT in axis.terms and EFFECT not in nominal.axes[name].terms:
            before, after = (open_loop(runs, each)[sense_channel(nominal, name)].error for each in (nominal, device))
            table, share = axis.terms[EFFECT], float(max(0.0, 1.0 - (after / before) ** 2))
            described[name] = {"frequency": table["frequency"], "quality": table["quality"], "share": share}
    return described


def _has_linear_drive(axis: Axis) -> bool:
    return axis.drive is not None and axis.drive.kind == "linear" and axis.mechanics is not None


def find_modes(runs: Sequence[Run], axis: Axis, single: bool = False) -> dict[str, float | list[float]] | None:
    """Further modes of one axis as the table of their term, None where the recordings show fewer than two.

    Modes are added to the mirror's own one where they take the most of the remaining power, and all are then fitted
    together, until none takes ``MIN_GAIN``.

    Args:
        single: whether one is enough. Then the residues are real, as of light damping: the phase that all modes have in
            common is that of a delay, which the diagnosis seeks.
    """
    bands = [band for run in runs if (band := _band(run, axis)) is not None]
    if len(bands) < len(runs):
        return None
    columns = _Columns(bands, residues=1 if single else 2)
    modes, residual = _fit(columns, np.array([[axis.resonance, axis.require_mechanics().quality]]))
    while len(modes) <= MAX_FURTHER_MODES:
        more, left = _fit(columns, np.vstack([modes, _next_mode(columns, modes, residual)]))
        if _power(left) > (1.0 - MIN_GAIN) * _power(residual) or not _is_further(more):
            break
        modes, residual = more, left
    fewest, most_left = 1 if single else MIN_FURTHER_MODES, MAX_RESIDUAL_RATIO**2 * columns.power
    if len(modes) - 1 < fewest or _power(residual) > most_left:
        return None
    heights, readout = _heights(columns, modes)[0], axis.readout
    assert isinstance(readout, MotionSensor)
    residues = heights[columns.residues : -1].reshape(len(modes) - 1, columns.residues) / readout.gain
    return {
        "frequency": modes[1:, 0].tolist(),
        "quality": modes[1:, 1].tolist(),
        "gain": residues[:, 0].tolist(),
        "gain_rate": (residues[:, 1] if columns.residues > 1 else np.zeros(len(residues))).tolist(),
        "direct": float(heights[-1]),
    }


def _is_further(modes: Array) -> bool:
    """Whether no mode lies within the width of the mirror's own one, which is the first."""
    (own, quality), others = modes[0], modes[1:, 0]
    return bool(np.all(np.abs(others - own) > OWN_WIDTHS * own / quality))


def _band(run: Run, axis: Axis) -> _Band | None:
    """The sense signal of an axis in the band of its drive, None where the drive is no broad band."""
    outputs = [output for output in run.outputs if output.kind == "sense" and axis.name in output.axes]
    if not outputs or axis.name not in run.inputs or not isinstance(axis.readout, MotionSensor):
        return None
    (output,), inputs = outputs, run.inputs[axis.name]
    voltage = nodes_to_samples(inputs.voltage)
    power = np.abs(_transform(output.sampled(voltage))) ** 2
    frequency = np.arange(power.size) / (output.data.size * output.step)
    smooth = np.convolve(power, np.ones(9) / 9, "same")
    total = np.cumsum(power) / max(power.sum(), 1e-300)
    middle = np.median(smooth[(total > 0.05) & (total < 0.95)]) if power.sum() else 0.0
    driven = (smooth > DRIVEN_POWER * middle) & (frequency > 0.0) & (total > 0.005) & (total < 0.995)
    if np.count_nonzero(driven) < 64:
        return None
    low, high = frequency[driven].min(), frequency[driven].max()
    if np.log2(high / low) < MIN_BAND_OCTAVES or driven.sum() < 0.5 * ((frequency >= low) & (frequency <= high)).sum():
        return None
    bins, order = np.flatnonzero(driven), axis.readout.order
    return _Band(output, voltage, inputs.step, order, bins, _transform(output.data)[bins], float(low), float(high))


class _Columns:
    """Responses of modes in all bands, real and imaginary parts below each other.

    Args:
        bands: of all recordings.
        residues: numbers a mode has: its gain, and that for the voltage's rate.
    """

    def __init__(self, bands: Sequence[_Band], residues: int = 2):
        self.bands, self.residues = tuple(bands), residues
        data = np.concatenate([band.data for band in bands])
        self.data = _real(data)
        self.power = float(self.data @ self.data)
        self._drive = np.concatenate([band.transform(band.voltage) for band in bands])[:, None]
        self._known: dict[tuple[float, float], Array] = {}

    def driven(self, frequency: float, quality: float) -> Array:
        """Of one mode, shape (rows, residues)."""
        return _real(np.concatenate([band.driven(frequency, quality)[:, : self.residues] for band in self.bands]))

    def table(self, modes: Array) -> Array:
        """Of all modes, then of the drive, then their decays in each recording, shape (rows, columns)."""
        known, n = [self._mode(*map(float, mode)) for mode in modes], self.residues
        return np.hstack([*(each[:, :n] for each in known), _real(self._drive), *(each[:, n:] for each in known)])

    def _mode(self, frequency: float, quality: float) -> Array:
        key = (frequency, quality)
        if key not in self._known:
            if len(self._known) >= CACHE_SIZE:
                self._known.clear()
            size = [band.bins.size for band in self.bands]
            decays = np.zeros((sum(size), 2 * len(size)), complex)
            for i, (band, last) in enumerate(zip(self.bands, np.cumsum(size), strict=True)):
                decays[last - size[i] : last, 2 * i : 2 * i + 2] = band.decay(frequency, quality)
            self._known[key] = np.hstack([self.driven(frequency, quality), _real(decays)])
        return self._known[key]


def _real(values: Array) -> Array:
    return np.concatenate([values.real, values.imag])


def _heights(columns: _Columns, modes: Array) -> tuple[Array, Array]:
    """Heights of the modes' responses and of the drive by linear least squares, and the residual."""
    table = columns.table(modes)
    size = np.linalg.norm(table, axis=0)
    size[size == 0.0] = 1.0  # a critically damped mode has no decay in quadrature
    heights = np.linalg.lstsq(table / size, columns.data, rcond=None)[0] / size
    return heights[: columns.residues * len(modes) + 1], columns.data - table @ heights


def _power(residual: Array) -> float:
    return float(residual @ residual)


def _fit(columns: _Columns, modes: Array) -> tuple[Array, Array]:
    """Modes of the least misfit from a start, shape (modes, 2), and the residual."""
    from scipy.optimize import least_squares

    def residual(x: Array) -> Array:
        return _heights(columns, np.exp(x.reshape(-1, 2)))[1]

    start = np.log(modes).ravel()
    reach = np.tile([0.2, 3.0], len(modes))
    low, high = start - reach, start + reach
    low[1::2] = np.maximum(low[1::2], np.minimum(np.log(MIN_MODE_QUALITY), start[1::2] - 1e-6))
    high[1::2] = np.maximum(np.log(MAX_QUALITY), start[1::2] + 1e-6)
    best = least_squares(residual, start, bounds=(low, high), x_scale=0.1 * reach, diff_step=1e-4, max_nfev=FIT_STEPS)
    return np.exp(best.x.reshape(-1, 2)), best.fun


def _next_mode(columns: _Columns, modes: Array, residual: Array) -> Array:
    """The mode that takes the most of the residual beside the others, over a grid in the band; shape (2,)."""
    basis = np.linalg.qr(columns.table(modes))[0]
    low, high = columns.bands[0].low, columns.bands[0].high
    best, gain = modes[0], -1.0
    for frequency in np.geomspace(low, 1.2 * high, GRID):
        trials = [
            (frequency, quality) for quality in QUALITIES if _is_further(np.vstack([modes[:1], [frequency, 1.0]]))
        ]
        for trial in trials:
            new = columns.driven(*trial)
            taken = np.linalg.qr(new - basis @ (basis.T @ new))[0].T @ residual
            if taken @ taken > gain:
                best, gain = np.array(trial), float(taken @ taken)
    return best
