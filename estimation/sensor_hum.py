"""Hum in a position signal: lines far below the resonance that no torque of the drive causes, and their removal.

The centre of a resonant motion is its mean over a period. A slow torque moves it by torque / k; the recorded drive
gives that part. What is left is an error of the sensor: a vibration of the frame of amplitude φ turns a balanced mirror
against it by φ (f / f0)² only. A line in it is hum, and is subtracted. A drift that is no line is not.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from math import ceil
from typing import NamedTuple

import numpy as np

from estimation.isolated_spikes import MAX_VALUE
from estimation.reference import MIN_RELATIVE_FREQUENCY
from scanner.arrays import Array
from scanner.channel import Channel, LazySamples
from scanner.device import Axis
from scanner.motion import AxisMotion
from scanner.recording import Recording
from scanner.replaced_samples import with_samples

MAX_HUM_FREQUENCY = 0.2
"""Frequency of hum over that of the slower axis, up to which it is distinguished from the motion of either axis."""

BLOCK_S = 0.5
"""Time over which frequency, amplitude and phase of hum are taken to be constant [s]."""

MIN_CYCLES = 1.5
"""Cycles of a line in a block, from which it is distinguished from a constant and a slope."""

STEPS_PER_CYCLE = 8
"""Frequencies of the periodogram per cycle in a block."""

REFINEMENTS = 12
"""Times that two frequencies on either side of the best one are tried, each time at half of the distance: to 1e-4 of a
cycle in a block."""

BACKFIT_ROUNDS = 3
"""Times that each line is fitted again without the others, beside which it was found: each removes most of the rest."""

MAX_LINES = 6
"""Lines of a block at most: the mains and its harmonics below ``MAX_HUM_FREQUENCY``."""

MAX_PASSED_CHANGE = 0.15
"""Part of a change of the amplitude or the phase that the mean over a period passes at most: a sideband at 0.8 of the
frequency of the motion by 0.12, the other one by 0.03."""

MIN_EXPLAINED_SHARE = 0.5
"""Share of the centre's variance in either half of a block that a line explains whose amplitude and phase are those of
the other half: noise and steps of a drift have none."""


MIN_CENTRES = 8
"""Fewest means over a period in which lines are searched: twice the parameters of a fit."""


class Line(NamedTuple):
    """A sinusoid ``cosine cos(2πft) + sine sin(2πft)``, t on the recording's clock: f [Hz], both parts [rad]."""

    frequency: float
    cosine: float
    sine: float

    @property
    def amplitude(self) -> float:
        """[rad]."""
        return float(np.hypot(self.cosine, self.sine))

    def at(self, time: Array) -> Array:
        """The line at times [s], shape (n,) [rad]."""
        phase = 2.0 * np.pi * self.frequency * time
        return np.asarray(self.cosine * np.cos(phase) + self.sine * np.sin(phase))


class LineBlock(NamedTuple):
    """Begin and end of a part of a recording [s], and the lines in it."""

    begin: float
    end: float
    lines: tuple[Line, ...]


def find_hum(
    recording: Recording, axis: Axis, name: str, angle: Channel, motion: AxisMotion, slower: float
) -> list[LineBlock]:
    """The hum in the position signal of an axis, in consecutive blocks; empty if there is none.

    Without a recorded drive and the mechanics of the device, the slow part of the torque is not known, and none is
    found. A line has to be larger than the changes of the motion, of which the mean over a period lets a part pass.

    Args:
        recording, axis: of the scan and its device.
        name: of the axis.
        angle: the position signal [rad].
        motion: from this signal.
        slower: frequency of the slower axis [Hz].
    """
    if not is_slow_drive_known(recording, axis, name, motion):
        return []
    frequency, rate, change = float(np.median(motion.frequency)), angle.sample_rate, _passed_change(motion)
    edges = part_edges(angle, 1.0 / frequency)
    blocks = []
    for first, stop in pairwise(edges):
        time, centre = _undriven_centre(recording, axis, name, angle, (first, stop), frequency)
        lines = find_lines(time, centre, MAX_HUM_FREQUENCY * slower, change)
        begin, end = (angle.start + at / rate for at in (first, stop))
        blocks.append(LineBlock(begin, end, tuple(_before_mean(line, rate, frequency) for line in lines)))
    return blocks if any(block.lines for block in blocks) else []


def part_edges(channel: Channel, mean_s: float) -> list[int]:
    """Numbers of the first samples of parts of about ``BLOCK_S``, and of the sample after the last part.

    Args:
        channel: of any shape.
        mean_s: time of a mean [s]; a part is long enough for ``MIN_CENTRES`` of them.
    """
    length = channel.sample_rate * max(BLOCK_S, (MIN_CENTRES + 1) * mean_s)
    return [int(edge) for edge in np.linspace(0, channel.size, max(1, round(channel.size / length)) + 1)]


def find_slow_lines(motion: AxisMotion, slower: float) -> list[Line]:
    """Lines in the centre of a motion during the first ``BLOCK_S``, whether a drive causes them or not.

    Args:
        motion: with measured angles.
        slower: frequency of the slower axis [Hz].
    """
    angle, frequency = motion.angle, float(np.median(motion.frequency))
    values = angle.read(0, min(angle.size, round(BLOCK_S * angle.sample_rate)))
    time, centre = means_over_periods(values, angle.sample_rate, angle.start, frequency)
    if time.size < MIN_CENTRES or not np.isfinite(centre).all():
        return []
    lines = find_lines(time, centre, MAX_HUM_FREQUENCY * slower, _passed_change(motion))
    return [_before_mean(line, angle.sample_rate, frequency) for line in lines]


def _passed_change(motion: AxisMotion) -> float:
    """Largest line that changes of an oscillation make in its mean over a period [rad]; infinite of an unknown one."""
    phasors = (motion.amplitude * np.exp(1j * motion.phase))[1:-1]
    return MAX_PASSED_CHANGE * float(np.sqrt(2.0) * np.std(phasors)) if phasors.size > 1 else np.inf


def without_hum(angle: Channel, hum: Sequence[LineBlock]) -> Channel:
    """The position signal [rad] less its hum, which is subtracted as the samples are read."""

    def fetch(first: int, stop: int) -> Array:
        return angle.read(first, stop) - sum_of_lines(hum, angle.time(first, stop))

    return with_samples(angle, LazySamples((angle.size,), np.dtype(np.float64), fetch))


def sum_of_lines(blocks: Sequence[LineBlock], time: Array) -> Array:
    """The lines of the blocks at increasing times [s], shape (n,)."""
    values = np.zeros(time.size)
    for block in blocks:
        low, high = np.searchsorted(time, [block.begin, block.end])
        for line in block.lines if low < high else ():
            values[low:high] += line.at(time[low:high])
    return values


def describe_hum(channel: Channel, gain: float, hum: Sequence[LineBlock]) -> list[str]:
    """A line on the hum that was subtracted.

    Args:
        channel: position signal.
        gain: unit of the channel per rad.
        hum: of this signal.
    """
    largest = max((line for block in hum for line in block.lines), key=lambda line: line.amplitude, default=None)
    if largest is None:
        return []
    frequencies = sorted({round(line.frequency) for block in hum for line in block.lines})
    others = f", with {len(frequencies) - 1} further lines from {frequencies[0]} to {frequencies[-1]} Hz"
    return [
        f"{channel.name}: holds a line at {largest.frequency:.4g} Hz with an amplitude of "
        f"{largest.amplitude * abs(gain):.3g} {channel.unit}, {largest.amplitude:.3g} rad"
        f"{others if len(frequencies) > 1 else ''}, which the drive does not cause: hum of the sensor, which was "
        "subtracted; check its shield and ground"
    ]


def is_slow_drive_known(recording: Recording, axis: Axis, name: str, motion: AxisMotion) -> bool:
    """Whether the slow part of the torque on an axis is known, and the axis moves near its resonance or above."""
    return (
        f"drive_{name}" in recording
        and axis.drive is not None
        and axis.mechanics is not None
        and motion.reference in ("drive", "half-drive")
        and float(np.median(motion.frequency)) >= MIN_RELATIVE_FREQUENCY * axis.resonance
        and (axis.drive.kind != "linear" or axis.drive.torque_per_volt is not None)
    )


def _undriven_centre(
    recording: Recording, axis: Axis, name: str, angle: Channel, part: tuple[int, int], frequency: float
) -> tuple[Array, Array]:
    """Times [s] and centre of the motion less what the slow part of a known drive causes [rad].

    Args:
        recording, axis, name, angle: as for :func:`find_hum`.
        part: range of samples (first, stop) of the angle.
        frequency: of the motion [Hz].
    """
    time, centre = means_over_periods(angle.read(*part), angle.sample_rate, float(angle.time(*part)[0]), frequency)
    if axis.drive is not None and axis.drive.kind == "linear":
        drive = recording[f"drive_{name}"]
        begin, end = ((angle.time(at, at + 1)[0] - drive.start) * drive.sample_rate for at in (part[0], part[1] - 1))
        first, stop = (min(max(int(at), 0), drive.size) for at in (begin, end + 1.0))
        driven = slow_drive_angle(axis, drive, (first, stop), frequency, time)
        if driven is None:
            return time[:0], centre[:0]
        centre = centre - driven
    known = np.isfinite(centre)
    return (time, np.interp(time, time[known], centre[known])) if known.sum() >= MIN_CENTRES else (time[:0], centre[:0])


def slow_drive_angle(axis: Axis, drive: Channel, part: tuple[int, int], frequency: float, time: Array) -> Array | None:
    """Angle to which the slow part of a linear drive turns an axis, shape of ``time`` [rad]; None where it is unknown.

    Args:
        axis: driven.
        drive: its voltage.
        part: range of samples (first, stop) of the drive.
        frequency: of the motion [Hz].
        time: [s].
    """
    if axis.drive is None or axis.drive.torque_per_volt is None or axis.mechanics is None:
        return None
    start = drive.start + part[0] / drive.sample_rate
    times, means = means_over_periods(drive.read(*part), drive.sample_rate, start, frequency)
    if means.size < MIN_CENTRES:
        return None
    return np.asarray(axis.drive.torque_per_volt / axis.mechanics.k * np.interp(time, times, means))


def means_over_periods(values: Array, rate: float, start: float, frequency: float) -> tuple[Array, Array]:
    """Times [s] and means of an oscillation without its period, one value a period.

    Each is weighted by a Hann window of two periods, which cancels a sine of the period and its harmonics, also where
    the amplitude changes.
    """
    window = mean_window(rate, frequency)
    length = window.size // 2
    finite = np.where(np.isfinite(values), values, np.nan)
    periods = finite[: values.size // length * length].reshape(-1, length)
    means = np.asarray(periods[:-1] @ window[:length] + periods[1:] @ window[length:], np.float64)
    return np.asarray(start + np.arange(1, means.size + 1) * length / rate, np.float64), means


def mean_window(rate: float, frequency: float) -> Array:
    """A Hann window of two periods, of sum 1, over twice the samples of a period, rounded up.

    A window of whole samples in place of the period lets 2 % of an oscillation of 8.5 samples a period pass, which the
    means then show as a slow line.
    """
    period = max(2.0, rate / frequency)
    length = ceil(period)
    lag = np.arange(-length, length)
    window = np.where(np.abs(lag) < period, 1.0 + np.cos(np.pi * lag / period), 0.0)
    return np.asarray(window / window.sum(), np.float64)


def _before_mean(line: Line, rate: float, frequency: float) -> Line:
    """The line in the samples, of one in their means over periods of ``frequency`` [Hz]."""
    window = mean_window(rate, frequency)
    lag = np.arange(window.size) - window.size // 2
    kept = float(window @ np.cos(2.0 * np.pi * line.frequency * lag / rate))
    return Line(line.frequency, line.cosine / kept, line.sine / kept)


def find_lines(time: Array, values: Array, highest: float, smallest: float) -> list[Line]:
    """Lines of a slow signal, the largest first; each half of the signal shows what is in the other one.

    Args:
        time: [s], increasing, shape (n,).
        values: shape (n,).
        highest: frequency of a line at most [Hz].
        smallest: amplitude of a line at least.
    """
    lines = list[Line]()
    if values.size < MIN_CENTRES or not np.abs(values).max() < MAX_VALUE:
        return lines
    while len(lines) < MAX_LINES:
        line = _strongest_line(time, values, highest)
        if line is None or line.amplitude <= smallest or not _is_in_both_halves(time, values, line.frequency):
            break
        lines.append(line)
        values = values - line.at(time)
    for number in [*range(len(lines))] * (BACKFIT_ROUNDS if len(lines) > 1 else 0):
        line = lines[number]
        alone = values + line.at(time)
        lines[number] = _refine(time, alone, line.frequency, 1.0 / (STEPS_PER_CYCLE * float(time[-1] - time[0])))
        values = alone - lines[number].at(time)
    return lines


def _strongest_line(time: Array, values: Array, highest: float) -> Line | None:
    """The line that leaves the least of a signal beside a constant and a slope; None where none explains much of it.

    The search starts at the maximum of the periodogram.
    """
    duration, padded = float(time[-1] - time[0]), STEPS_PER_CYCLE * values.size
    left = _residual(time, values)
    frequencies = np.fft.rfftfreq(padded, duration / (values.size - 1))
    power = np.abs(np.fft.rfft(left, padded)) ** 2
    power[(frequencies < MIN_CYCLES / duration) | (frequencies > highest)] = 0.0
    strongest, total = int(np.argmax(power)), float(left @ left)
    if not 2.0 * power[strongest] > 0.5 * MIN_EXPLAINED_SHARE * values.size * total:
        return None
    return _refine(time, values, float(frequencies[strongest]), float(frequencies[1]))


def _refine(time: Array, values: Array, frequency: float, step: float) -> Line:
    """The line of a signal near a frequency, with ``step`` to the next ones [Hz]."""
    for _ in range(REFINEMENTS):
        near = frequency + step * np.arange(-2, 3)
        frequency = float(near[int(np.argmin([_fit(time, values, each)[1] for each in near]))])
        step *= 0.5
    return _fit(time, values, frequency)[0]


def _fit(time: Array, values: Array, frequency: float) -> tuple[Line, float]:
    """The line of a frequency [Hz] in a signal, beside a constant and a slope, and the mean square that is left."""
    phase = 2.0 * np.pi * frequency * time
    columns = np.column_stack([np.cos(phase), np.sin(phase), np.ones(time.size), time - time[0]])
    found = np.linalg.lstsq(columns, values, rcond=None)[0]
    return Line(frequency, *found[:2].tolist()), float(np.mean(np.square(values - columns @ found)))


def _is_in_both_halves(time: Array, values: Array, frequency: float) -> bool:
    """Whether the line of each half of a signal explains ``MIN_EXPLAINED_SHARE`` of the other half's variance."""
    half = time.size // 2
    halves = [(time[part], values[part]) for part in (slice(None, half), slice(half, None))]
    for (known, shown), (other, hidden) in (halves, halves[::-1]):
        line = _fit(known, shown, frequency)[0]
        left, total = (float(np.var(_residual(other, each))) for each in (hidden - line.at(other), hidden))
        if not left < (1.0 - MIN_EXPLAINED_SHARE) * total:
            return False
    return True


def _residual(time: Array, values: Array) -> Array:
    """A signal less a constant and a slope, shape (n,)."""
    since = time - time.mean()
    slope = float(since @ values) / float(since @ since)
    return np.asarray(values - values.mean() - slope * since)
