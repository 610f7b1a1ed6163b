"""Resonance and damping from a free decay without a reference angle: from the readout's own signal.

The angle is A exp(-g t) sin(w t + phase). A sensor of the motion shows a linear function of it. A capacitive readout
shows the comb's law of theta / theta0, so that the amplitude is determined in units of theta0 only. Gain and offset of
either readout are eliminated as linear parameters.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from estimation.identification.agreement import (
    Differences,
    IdentifiedValue,
    amplitude_columns,
    difference_by_extra_columns,
    widen,
)
from estimation.identification.capacitance_profile import SECTION_SAMPLES_PER_CYCLE
from estimation.identification.classification import shows_motion
from estimation.identification.fits import MAX_RINGDOWN_RESIDUAL_RATIO, SETTLE_TIME_S
from estimation.reference import MIN_SAMPLES_PER_PERIOD, sampled_too_slowly
from scanner.arrays import Array
from scanner.channel import Channel
from scanner.device import Axis
from scanner.errors import BadInput
from scanner.lowpass import apply_lowpass
from scanner.stages import Amdm, MotionSensor, Transimpedance

MIN_CYCLES = 8.0
"""Cycles of a decay that are needed: its frequency and its damping are then distinct in the first fit window."""

LINE_CYCLES = 40.0
"""Cycles from the start in whose spectrum the frequency is first found."""

MAX_SAMPLES_PER_CYCLE = 40
"""Samples a cycle that are fitted: the harmonics of a comb are resolved up to the eighth."""

START_AMPLITUDES = (0.15, 0.5, 1.0)
"""Starts of the amplitude behind a capacitive readout, in units of theta0."""

DERIVATIVE_STEP = 1e-4
"""Step of numerical derivatives by phase [rad] and log amplitude: their error is then below 1e-8."""

SMALL_LOG_AMPLITUDE, MIN_AMPLITUDE_SDS = np.log(1e-2), 3.0
"""An amplitude in units of theta0 at which the comb's law is its series to 1e-4, and the distance from it in standard
deviations from which the amplitude is reported: below, its interval includes zero."""

MIN_DECAY_SDS = 3.0
"""Rate of decay in standard deviations below which a motion is no decay: its interval then includes a motion without
end."""


def fit_decay_without_angle(axis: Axis, channel: Channel) -> dict[str, IdentifiedValue]:
    """``k_over_J`` [1/s2], ``b_over_J`` [1/s] and, behind a capacitive readout, ``amplitude_over_theta0``.

    The amplitude is left out where a small one fits as well: then the signal has the shape of the comb's law near zero.

    Raises:
        BadInput: fewer than ``MIN_CYCLES`` cycles, or the signal does not follow a free decay.
    """
    from scipy.optimize import least_squares

    readout, resonance = axis.require_readout(), axis.resonance
    order = 1 if isinstance(readout, MotionSensor) else 2
    if channel.sample_rate < MIN_SAMPLES_PER_PERIOD * order * resonance:
        raise sampled_too_slowly(channel, "a resonance", resonance, order, ", or correct J and k of the device")
    cycles = channel.size / channel.sample_rate * resonance
    if cycles < 0.5 * MIN_CYCLES:  # of the nominal resonance; that of the signal is known later
        hint = f"record {MIN_CYCLES:g} cycles or more"
        raise BadInput(f"holds {cycles:.3g} cycles of a free decay", file=channel.file, channel=channel.name, hint=hint)
    w0 = 2 * np.pi * _line(channel, order * resonance) / order
    stride = max(1, int(channel.sample_rate * 2 * np.pi / w0 / MAX_SAMPLES_PER_CYCLE))
    y = channel.read()[::stride]
    time = np.arange(y.size) * stride / channel.sample_rate
    cycles = time[-1] * w0 / (2 * np.pi)
    if cycles < MIN_CYCLES:
        hint = f"record {MIN_CYCLES:g} cycles or more"
        raise BadInput(f"holds {cycles:.3g} cycles of a free decay", file=channel.file, channel=channel.name, hint=hint)
    sections = readout.lpf_hz if isinstance(readout, Amdm) else ()
    skip = round(SETTLE_TIME_S / stride * channel.sample_rate) if sections else 0
    finer = max(1, round(SECTION_SAMPLES_PER_CYCLE * cycles / y.size)) if sections else 1
    theta_th = 0.0 if order == 1 else axis.require_capacitance().theta_th / axis.require_capacitance().theta0

    def basis(x: Array, n: int) -> Array:
        """Signals that gain and offset multiply, shape (n, 2 or 3)."""
        t = np.arange((n - 1) * finer + 1) * (time[1] / finer)
        rate, decay = w0 * (1.0 + x[0]), first_decay * x[1]
        envelope, turn = np.exp(-decay * t), rate * t
        if order == 1:
            return np.stack([envelope * np.cos(turn), envelope * np.sin(turn), np.ones(n)], axis=1)
        theta = np.exp(x[2]) * envelope * np.sin(turn + x[3])
        u = theta - theta_th
        shape = np.exp(-u * u)
        if isinstance(readout, Transimpedance):
            speed = np.exp(x[2]) * envelope * (rate * np.cos(turn + x[3]) - decay * np.sin(turn + x[3])) / w0
            shape = -2.0 * u * shape * speed
        for cutoff in sections:
            shape = apply_lowpass(shape, cutoff, time[1] / finer)
        return np.stack([shape[::finer], np.ones(n)], axis=1)

    def residual(x: Array, n: int) -> Array:
        columns, part = basis(x, n)[skip:], y[skip:n]
        return np.asarray(part - columns @ np.linalg.lstsq(columns, part, rcond=None)[0])

    first_decay = max(-_log_slope(y, time, order), 0.05 / time[-1])
    starts = [np.array([0.0, 1.0])]
    if order == 2:
        phases = np.pi * np.arange(8) / 8
        starts = [np.array([0.0, 1.0, np.log(a), p]) for a in START_AMPLITUDES for p in phases]
    per_cycle = y.size / cycles
    windows = [round(per_cycle * c) for c in (6.0, 25.0, 100.0, 400.0, 1600.0, 6400.0) if c < 0.7 * cycles]
    x = min(starts, key=lambda x: float(np.sum(residual(x, windows[0] if windows else y.size) ** 2)))
    for n in (*windows, y.size):
        tried = [x] if order == 1 else [np.array([*x[:2], np.log(a), x[3]]) for a in START_AMPLITUDES]
        solutions = [least_squares(residual, each, args=(n,), x_scale="jac") for each in tried]
        solution = min(solutions, key=lambda each: float(each.cost))
        x = solution.x
    left = solution.fun
    signal = y[: max(y.size // 4, windows[0] if windows else 0)]
    if left.std() > MAX_RINGDOWN_RESIDUAL_RATIO * signal.std() and shows_motion(left):
        what = "does not follow a free decay of a linear resonator"
        hint = (
            "cut the record to the decay alone, without a bias that changes it; `lissajous diagnose` finds other laws"
        )
        raise BadInput(what, file=channel.file, channel=channel.name, hint=hint)
    variance = float(left @ left) / max(y.size - x.size - basis(x, y.size).shape[1], 1)
    sd = np.sqrt(variance * np.diag(np.linalg.inv(solution.jac.T @ solution.jac)))
    if x[1] < MIN_DECAY_SDS * sd[1]:
        what, hint = "holds a motion that does not decay", "record a free decay, or record the drive beside the motion"
        raise BadInput(what, file=channel.file, channel=channel.name, hint=hint)
    rate, decay = w0 * (1.0 + x[0]), float(first_decay * x[1])
    change = _amplitude_dependence(lambda x: basis(x, y.size)[skip:], x, solution.jac, y[skip:], time[skip:], decay)
    scale = np.array([2.0 * rate * w0, 2.0 * first_decay])
    stiffness_sd, loss_sd = scale * sd[:2]
    ratios = [
        IdentifiedValue(float(rate**2 + decay**2), float(stiffness_sd)),
        IdentifiedValue(2.0 * decay, float(loss_sd)),
    ]
    values = dict(zip(("k_over_J", "b_over_J"), widen(ratios, change.select([0, 1], scale)), strict=True))
    if order == 1:
        return values
    rest = np.delete(x, 2)
    small = least_squares(lambda rest: residual(np.insert(rest, 2, SMALL_LOG_AMPLITUDE), y.size), rest, x_scale="jac")
    if 2.0 * (small.cost - solution.cost) > MIN_AMPLITUDE_SDS**2 * variance:
        values["amplitude_over_theta0"] = IdentifiedValue(float(np.exp(x[2])), float(np.exp(x[2]) * sd[2]))
    return values


def _amplitude_dependence(
    basis: Callable[[Array], Array], x: Array, jacobian: Array, y: Array, time: Array, decay: float
) -> Differences:
    """Changes of the fitted parameters, then of gain and offset, if frequency and damping may depend on the amplitude.

    Args:
        basis: signals that gain and offset multiply, shape (n, 2 or 3), for parameters of shape (p,).
        x: fitted parameters, shape (p,). jacobian: derivative of the residual, shape (n, p).
        y: signal, time: [s], both of shape (n,). decay: rate of decay of the amplitude [1/s].
    """
    columns = basis(x)
    linear = np.linalg.lstsq(columns, y, rcond=None)[0]
    if x.size == 2:  # a sensor of the motion: cosine and sine
        by_phase = linear[1] * columns[:, 0] - linear[0] * columns[:, 1]
        by_log_amplitude = columns[:, :2] @ linear[:2]
    else:
        steps = DERIVATIVE_STEP * np.eye(x.size)[2:]
        by_log_amplitude, by_phase = (
            (basis(x + step) - basis(x - step))[:, 0] * (linear[0] / (2.0 * DERIVATIVE_STEP)) for step in steps
        )
    extra = amplitude_columns(time, 2.0 * decay, by_phase, by_log_amplitude)
    return difference_by_extra_columns(np.column_stack([-jacobian, columns]), extra, y - columns @ linear)


def _line(channel: Channel, near: float) -> float:
    """Frequency of the largest line within a quarter of ``near`` [Hz], in the first ``LINE_CYCLES`` cycles."""
    values = channel.read(0, round(LINE_CYCLES / near * channel.sample_rate))
    padded = 1 << (8 * values.size - 1).bit_length()
    spectrum = np.abs(np.fft.rfft((values - values.mean()) * np.hanning(values.size), padded))
    frequency = np.fft.rfftfreq(padded, 1.0 / channel.sample_rate)
    spectrum[(frequency < 0.8 * near) | (frequency > 1.25 * near)] = 0.0
    return float(frequency[np.argmax(spectrum)])


def _log_slope(y: Array, time: Array, order: int) -> float:
    """Slope of the logarithm of the amplitude, from the size of the signal in four quarters [1/s]."""
    parts = np.array_split(np.arange(y.size), 4)
    sizes = np.log([max(float(np.std(y[part])), 1e-300) for part in parts])
    return float(np.polyfit([time[part].mean() for part in parts], sizes, 1)[0]) / order
