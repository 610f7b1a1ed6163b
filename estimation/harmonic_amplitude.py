"""Amplitude of an axis by the harmonics of its capacitive signal, as a check of the estimated one.

The size of the signal's second harmonic gives the amplitude through the gains of the comb and of the readout; the
fourth harmonic over the second gives it through theta0 alone. An estimator weighs both and the response to the drive.
All agree if the device describes the mirror. They differ if the device file is of another mirror, a gain is wrong, or
the drive feeds through into the signal.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import hypot, sqrt
from typing import NamedTuple

import numpy as np

from estimation.amplitude_calibration import amplitude_sd_by_gain
from estimation.signals import SenseChannel, sense_channels
from estimation.tracker.demodulation import harmonic_basis
from scanner.active_terms import stated_terms
from scanner.arrays import Array, Complex
from scanner.device import Axis, Device
from scanner.harmonics import capacitance_harmonics, readout_response
from scanner.motion import AxisMotion, Motion
from scanner.recording import Recording
from scanner.stages import Amdm, Capacitance, Readout, Transimpedance

BLOCK_PERIODS = 20
"""Periods of the slowest axis in a block: the harmonics of two axes are apart by several lines of the block's
spectrum, and frequency and amplitude stay the same within it."""

MAX_BLOCKS = 16
"""Blocks, evenly over the recording. Each costs some milliseconds; their scatter gives the standard deviation."""

MIN_BLOCKS = 8
"""Fewer blocks do not give a standard deviation of the noise."""

FITTED_ORDERS = (1, 2, 3, 4, 6)
"""Harmonics of every axis that are fitted together: the two that are compared and the strongest others."""

RELATIVE_STEP = 1e-3
"""Relative change of the amplitude or of a cut-off frequency for a derivative."""

MIN_CONTRADICTION_SDS = 4.0
"""Difference of two amplitudes from which they contradict, in standard deviations. Those of the tolerances are round
numbers of a data sheet; a normal deviation exceeds it by chance once in 16 000 axes."""


LARGEST_SIGNAL_AMPLITUDE = 1.8
"""Amplitude at which the second harmonic of a Gaussian comb is largest, in units of theta0."""


@dataclass(frozen=True)
class HarmonicAmplitude:
    """Comparison of a harmonic with the one that the device gives at the estimated amplitude.

    Attributes:
        ratio: of the second harmonic, or of the fourth over the second one, to what the device gives.
        difference: relative change of the amplitude that makes them equal, to first order.
        sd: its standard deviation by the noise and by the stated tolerances.
    """

    ratio: float
    difference: float
    sd: float

    @property
    def contradicts(self) -> bool:
        """Whether noise and tolerances do not explain the difference."""
        return abs(self.difference) > MIN_CONTRADICTION_SDS * self.sd


class AmplitudeCheck(NamedTuple):
    """Comparison of an estimated amplitude with the size and the shape of the signal."""

    size: HarmonicAmplitude
    shape: HarmonicAmplitude

    @property
    def error_sd(self) -> float:
        """Relative standard deviation of the amplitude by contradictions, 0 where there is none."""
        return max((abs(each.difference) for each in self if each.contradicts), default=0.0)


def check_amplitudes(recording: Recording, device: Device, motion: Motion) -> dict[str, AmplitudeCheck]:
    """Compare the amplitude of every axis with its capacitive signal.

    Args:
        recording, device: of the scan.
        motion: estimated from its sense channels.

    Returns:
        By axis. An axis is left out if its signal is not capacitive, a term of the device changes the harmonics, or the
        recording is too short.
    """
    return {
        name: _check(blocks, comb, readout, device, name)
        for name, blocks, comb, readout in _capacitive_axes(recording, device, motion)
        if (blocks.amplitude > 0.0).sum() >= MIN_BLOCKS
    }


def relative_signal_sizes(recording: Recording, device: Device, motion: Motion) -> dict[str, float]:
    """Second harmonic of the signal of every axis over the largest one that its comb gives at any amplitude.

    Args and axes as for :func:`check_amplitudes`, from one block of ``BLOCK_PERIODS`` on.
    """
    sizes = {}
    for name, blocks, comb, readout in _capacitive_axes(recording, device, motion):
        measured = np.abs(blocks.second / readout_response(readout, 2 * blocks.frequency))
        largest = abs(capacitance_harmonics(LARGEST_SIGNAL_AMPLITUDE * comb.theta0, comb)[2])
        sizes[name] = float(np.median(measured)) / float(largest)
    return sizes


def _capacitive_axes(
    recording: Recording, device: Device, motion: Motion
) -> Iterator[tuple[str, _Blocks, Capacitance, Amdm | Transimpedance]]:
    """Each axis with a capacitive signal whose harmonics no term of the device changes."""
    for sense in sense_channels(recording, device, gaps_ok=True):
        if not isinstance(sense.readout, (Amdm, Transimpedance)):
            continue
        for name, blocks in _harmonics(sense, motion).items():
            axis = device.sensed_axis(name)
            if axis.capacitance is not None and not _changes_harmonics(axis):
                yield name, blocks, axis.capacitance, sense.readout


def _changes_harmonics(axis: Axis) -> bool:
    """Whether the device states a term of the comb or of the readout."""
    return any(each.term.stage not in ("mechanics", "drive", "optics") for each in stated_terms(axis))


class _Blocks(NamedTuple):
    """Harmonics of one axis in the blocks, each of shape (blocks,): of the signal [V], with frequency [Hz] and
    amplitude [rad] of the motion."""

    second: Complex
    fourth: Complex
    frequency: Array
    amplitude: Array


def _harmonics(sense: SenseChannel, motion: Motion) -> dict[str, _Blocks]:
    """Harmonics of every axis of a sense channel, in blocks in which no sample is missing."""
    channel, axes = sense.channel, {name: motion.axes[name] for name in sense.axes if name in motion.axes}
    slowest = min(float(np.median(axis.frequency)) for axis in axes.values())
    length = int(np.ceil(BLOCK_PERIODS / slowest * channel.sample_rate))
    lines = list(product(range(len(axes)), FITTED_ORDERS))
    rows: dict[str, list[tuple[complex, complex, float, float]]] = {name: [] for name in axes}
    number = min(MAX_BLOCKS, channel.size // length)
    for first in np.linspace(0, channel.size - length, number, dtype=int) if number else ():
        values, time = channel.read(first, first + length), channel.start + (first + length / 2) / channel.sample_rate
        if not np.isfinite(values).all():
            continue
        states = [_state(axis, time) for axis in axes.values()]
        frequencies = np.array([frequency for frequency, _ in states])
        found = dict(zip(lines, _fit_lines(values, channel.sample_rate, lines, frequencies), strict=True))
        for index, name in enumerate(axes):
            rows[name].append((found[index, 2], found[index, 4], *states[index]))
    return {
        name: _Blocks(*(np.array(column) for column in zip(*row, strict=True))) for name, row in rows.items() if row
    }


def _state(axis: AxisMotion, time: float) -> tuple[float, float]:
    """Frequency [Hz] and amplitude [rad] at a time [s]."""
    return float(np.interp(time, axis.time, axis.frequency)), float(np.interp(time, axis.time, axis.amplitude))


def _fit_lines(values: Array, rate: float, lines: Sequence[tuple[int, int]], frequencies: Array) -> Complex:
    """Least-squares coefficients c of Re(c exp(i n w t)) about the middle of a signal with an offset, shape (lines,).

    Args:
        values: shape (n,), at ``rate`` [Hz].
        lines: (index of the frequency, order n) of each.
        frequencies: w / 2 pi, shape (axes,) [Hz].
    """
    basis = harmonic_basis(values.size, rate, np.array(lines), 2 * np.pi * frequencies)
    coefficients = np.linalg.lstsq(basis @ basis.T, basis @ values)[0][1:]
    return np.asarray(coefficients[::2] - 1j * coefficients[1::2])


class _Ratio(NamedTuple):
    """Measured over expected harmonic, its standard deviation by the noise, and d ln expected / d ln A."""

    value: float
    sd: float
    slope: float


def _check(blocks: _Blocks, comb: Capacitance, readout: Readout, device: Device, name: str) -> AmplitudeCheck:
    second = blocks.second / readout_response(readout, 2 * blocks.frequency)
    fourth = blocks.fourth / readout_response(readout, 4 * blocks.frequency)
    in_phase = (fourth * np.exp(-2j * np.angle(second))).real  # at the phase that the second one determines
    amplitudes = np.outer([1.0 - RELATIVE_STEP, 1.0, 1.0 + RELATIVE_STEP], blocks.amplitude)
    expected = np.array([[capacitance_harmonics(each, comb)[[2, 4]] for each in row] for row in amplitudes])
    two, four = _ratio(np.abs(second), np.abs(expected[:, :, 0])), _ratio(in_phase, expected[:, :, 1].real)
    shape = _Ratio(four.value / two.value, hypot(four.sd, two.sd * four.value) / two.value, four.slope - two.slope)
    by_gain = amplitude_sd_by_gain(device, name, float(blocks.amplitude.mean()))
    lowpass = _lowpass_sds(readout, float(blocks.frequency.mean()), device, name)
    return AmplitudeCheck(
        _compare(two, float(lowpass[0]), by_gain), _compare(shape, float(lowpass[1] - lowpass[0]), by_gain)
    )


def _ratio(measured: Array, expected: Array) -> _Ratio:
    """Least-squares factor of an expected harmonic; blocks with a large amplitude have a large weight.

    Args:
        measured: shape (blocks,).
        expected: for an amplitude less than, equal to and more than the estimated one by ``RELATIVE_STEP``, shape
            (3, blocks).
    """
    behind, at, ahead = expected
    value = measured @ at / (at @ at)
    noise = sqrt(np.sum((at * (measured - value * at)) ** 2) * at.size / (at.size - 1)) / (at @ at)
    return _Ratio(float(value), float(noise), float(at @ (ahead - behind) / (2 * RELATIVE_STEP * (at @ at))))


def _compare(ratio: _Ratio, lowpass_sd: float, amplitude_sd: float) -> HarmonicAmplitude:
    """The amplitude by a ratio, which has a standard deviation by the low-pass; ``amplitude_sd`` is by the gain."""
    sd = hypot(hypot(ratio.sd, lowpass_sd) / ratio.slope, amplitude_sd)
    return HarmonicAmplitude(ratio.value, (ratio.value - 1.0) / ratio.slope, sd)


def _lowpass_sds(readout: Readout, frequency: float, device: Device, name: str) -> Array:
    """Relative change of the second and fourth harmonic by the tolerance of the cut-off frequencies, shape (2,)."""
    if not isinstance(readout, Amdm):
        return np.zeros(2)
    higher = replace(readout, lpf_hz=tuple((1.0 + RELATIVE_STEP) * each for each in readout.lpf_hz))
    harmonics = np.array([2.0, 4.0]) * frequency
    changes = np.abs(readout_response(higher, harmonics) / readout_response(readout, harmonics)) - 1.0
    return np.asarray(device.tolerance(name, "lpf_hz") / RELATIVE_STEP * changes)
