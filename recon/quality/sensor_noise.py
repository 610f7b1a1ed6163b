"""Whether a sensor of the motion holds more than noise: a search for lines where the motion is expected.

Under the null hypothesis, noise whose spectrum is smooth, the power of a Hann-windowed spectrum at one frequency is
exponentially distributed about the noise level. The level is the median of the surrounding frequencies, so that a ratio
of power to level has an F distribution, which contains the uncertainty of the level. The smallest probability found is
multiplied by the number of powers that were searched (Bonferroni).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from math import ceil

import numpy as np
from scipy.special import fdtrc, gammaincinv

from estimation.estimate import default_estimator
from estimation.filters.baselines import find_position_signal
from estimation.reference import dominant_frequency
from estimation.signals import is_capacitive, sense_channels
from scanner.arrays import Array
from scanner.channel import Channel
from scanner.device import AXES, Device
from scanner.errors import BadInput
from scanner.recording import Recording
from scanner.stages import Position

FALSE_ALARM_PROBABILITY = 1e-3
"""Probability that noise alone passes as a motion. A sensor of noise that passes is refused by the estimator or gives a
useless picture; a usable sensor that is refused stops the work. The value is therefore not smaller."""

BAND = (0.8, 1.25)
"""Range of a motion's frequency over its nominal one in which it is searched, as the tracker does without a drive: a
stiffness that is wrong or drifts by 50 %."""

SURROUNDING = 1.25
"""Factor by which the frequencies whose median is the noise level extend beyond a band on either side."""

PIECE_SAMPLES = 1 << 18
"""Samples that are searched at a time. A line of a sensor that works is found in the first piece."""

SEGMENTS = (1, 4, 16)
"""Numbers of segments of a piece whose spectra are searched, one by one and as their mean: the whole piece is most
sensitive to a steady line, a short segment to one that drifts, begins late or decays."""

SAMPLES_PER_CYCLE = 8
"""Samples per cycle of the highest frequency down to which samples are averaged: 97 % of its amplitude is left."""

LEVEL_ORDINATES = 256
"""Frequencies whose median is one noise level: it is then known to 13 %, and coloured noise is flat across them."""

MIN_LEVEL_ORDINATES = 16
"""Fewest frequencies that give a noise level. With fewer, a line 100 times above the noise is no proof of a motion."""

LEVEL_EFFICIENCY = 0.247
"""Independent mean powers that are as accurate as the median of one: ln(2)^2 for the median of an exponential
distribution, times 18/35 for the correlation of neighbouring powers under a Hann window."""

READ_SAMPLES = 1 << 20
"""Samples that are read at a time while they are averaged, which bounds the memory."""

POSITION_ESTIMATORS = ("sensor", "sine-ukf")
"""Estimators that follow a position signal of any waveform."""

SENSE_ESTIMATORS = ("tracker", "tracker-causal", "ekf", "ukf", "hyb", "acm", "constant")
"""Estimators that follow a resonant motion in a sense signal."""


@dataclass(frozen=True)
class Sensor:
    """A channel that an estimator follows, and where its motion is expected.

    Attributes:
        channel: with the motion.
        axes: whose motion it carries.
        bands: lowest and highest frequency of each range in which a line is expected [Hz]; none if any is possible.
        any_waveform: whether the estimator can follow what lies outside the bands.
    """

    channel: Channel
    axes: tuple[str, ...]
    bands: tuple[tuple[float, float], ...]
    any_waveform: bool


@dataclass(frozen=True)
class LineSearch:
    """Result of a search for lines.

    Attributes:
        found: whether a line exceeds the noise with a false-alarm probability below ``FALSE_ALARM_PROBABILITY``.
        frequency: of the strongest line in the spectrum of one piece [Hz].
        ratio: its power over the noise around it.
        needed: this ratio from which a steady line is found.
    """

    found: bool
    frequency: float
    ratio: float
    needed: float


def check_sensor_noise(recording: Recording, device: Device, estimator: str | None) -> list[str]:
    """Check that every sensor that the estimator follows holds more than noise.

    Args:
        recording: with the channels of the motion.
        device: with resonances and readouts.
        estimator: name of the estimator; the default one where None.

    Returns:
        A line for each position sensor that moves, but not at the frequency of its drive.

    Raises:
        BadInput: a sensor shows no line where the motion is expected.
    """
    notes = []
    for sensor in _sensors_in_use(recording, device, estimator or default_estimator(recording, device)):
        channel = sensor.channel
        expected = search_lines(channel, sensor.bands)
        if expected is None or expected.found:
            continue
        other = search_lines(channel, ()) if sensor.bands else None
        where = _in_words(sensor.bands)
        what = (
            f"{where} the strongest line, at {expected.frequency:.6g} Hz, has {expected.ratio:.3g} times the power of "
            f"the noise around it, and from {expected.needed:.3g} times on it would be a motion"
        )
        hint = "check the sensor, its cable and its amplifier, and the drive" + _alternatives(recording, device, sensor)
        if other is None or not other.found:
            raise BadInput(f"holds noise only: {what}", file=channel.file, channel=channel.name, hint=hint)
        elsewhere = f"its strongest line is at {other.frequency:.6g} Hz"
        if not sensor.any_waveform:
            what = f"shows no motion: {what}; {elsewhere}"
            raise BadInput(what, file=channel.file, channel=channel.name, hint=hint)
        notes.append(f"{channel.name}: shows no motion at the frequency of the drive: {what}; {elsewhere}; {hint}")
    return notes


def search_lines(channel: Channel, bands: Sequence[tuple[float, float]]) -> LineSearch | None:
    """Search a channel for lines, piece by piece until one is found.

    Args:
        channel: samples that are not finite count as the mean.
        bands: lowest and highest frequency of each range to search [Hz]; all frequencies if empty.

    Returns:
        The result of the piece with the line, else of the first piece; None if the channel is too short or too slow to
        determine a noise level, or constant.
    """
    first: LineSearch | None = None
    lengths = _averaging_lengths(channel, bands)
    pieces = sum(max(1, ceil(channel.size // length / PIECE_SAMPLES)) for length in lengths)
    for length in lengths:
        rate = channel.sample_rate / length
        used = [(low, min(high, 0.5 * rate)) for low, high in bands or [(0.0, 0.5 * rate)]]
        for values in _pieces(channel, length):
            result = _search_piece(values, rate, used, FALSE_ALARM_PROBABILITY / pieces)
            if result is not None and result.found:
                return result
            first = first or result
    return first


def _search_piece(
    values: Array, rate: float, bands: Sequence[tuple[float, float]], false_alarm: float
) -> LineSearch | None:
    """Search one piece of samples; None if it does not determine a noise level."""
    lowest, searched, steady = 1.0, 0, []
    if not np.ptp(values) > 0.0:
        return None
    for segments in SEGMENTS:
        length = values.size // segments
        parts = values[: length * segments].reshape(segments, length)
        parts = parts - parts.mean(axis=1, keepdims=True)
        powers = np.square(np.abs(np.fft.rfft(parts * np.hanning(length), axis=1))) if length else np.zeros((1, 0))
        frequency = np.arange(powers.shape[1]) * rate / max(length, 1)
        for low, high in bands:
            around = _rows(frequency, low / SURROUNDING, high * SURROUNDING)
            inside = slice(*np.searchsorted(frequency[around], (low, high)))
            if around.stop - around.start < MIN_LEVEL_ORDINATES or inside.stop <= inside.start:
                continue
            for spectra, count in ((powers[:, around], 1), (powers[:, around].mean(axis=0)[None], segments)):
                ratio, independent = _power_ratios(spectra, count)
                probability = fdtrc(2 * count, 2 * count * independent, ratio[:, inside])
                lowest, searched = min(lowest, float(probability.min())), searched + probability.size
                if segments == 1:
                    at = int(ratio[0, inside].argmax())
                    steady.append((float(ratio[0, inside][at]), float(frequency[around][inside][at]), independent))
                    break  # the mean of one spectrum is the same
    if not steady:
        return None
    strongest, at, equivalent = max(steady)
    needed = equivalent * ((false_alarm / searched) ** (-1.0 / equivalent) - 1.0)
    return LineSearch(lowest * searched < false_alarm, at, strongest, needed)


def _rows(frequency: Array, low: float, high: float) -> slice:
    """The frequencies from ``low`` to ``high``, without the lowest two and the highest, which the window disturbs."""
    first, stop = np.searchsorted(frequency, (low, high))
    return slice(max(int(first), 2), max(min(int(stop), frequency.size - 1), 2))


def _power_ratios(powers: Array, count: int) -> tuple[Array, float]:
    """Powers over the noise level around each.

    Args:
        powers: means of ``count`` spectra, shape (spectra, frequencies).
        count: number of spectra in each mean.

    Returns:
        (ratios, of the shape of ``powers``; mean powers that determine the level as well as the median does).
    """
    groups = np.array_split(np.arange(powers.shape[1]), max(1, powers.shape[1] // LEVEL_ORDINATES))
    median_of_one = gammaincinv(count, 0.5) / count
    levels = np.stack([np.median(powers[:, group], axis=1) for group in groups], axis=1) / median_of_one
    centres, at = [float(group.mean()) for group in groups], np.arange(powers.shape[1])
    level = np.stack([np.interp(at, centres, each) for each in levels])
    return powers / np.maximum(level, np.finfo(float).tiny), LEVEL_EFFICIENCY * groups[-1].size


def _averaging_lengths(channel: Channel, bands: Sequence[tuple[float, float]]) -> tuple[int, ...]:
    """Samples that are averaged: as the bands allow; without bands one, then as many as make the whole one piece."""
    if bands:
        highest = max(high for _, high in bands)
        return (max(1, int(channel.sample_rate / (SAMPLES_PER_CYCLE * highest))),)
    whole = ceil(channel.size / PIECE_SAMPLES)
    return (1, whole) if whole > 1 else (1,)


def _pieces(channel: Channel, length: int) -> Iterator[Array]:
    """Pieces of a channel with ``length`` samples averaged, without gaps: values that are not finite are the mean."""
    rows, chunk = length * PIECE_SAMPLES, length * max(1, READ_SAMPLES // length)
    for first in range(0, channel.size - length + 1, rows):
        stop = min(first + rows, channel.size // length * length)
        reads = [channel.read(a, min(a + chunk, stop)) for a in range(first, stop, chunk)]
        finite = [np.isfinite(read) for read in reads]
        number = sum(int(each.sum()) for each in finite)
        mean = sum(float(read[each].sum()) for read, each in zip(reads, finite, strict=True)) / max(number, 1)
        filled = [np.where(each, read, mean) for read, each in zip(reads, finite, strict=True)]
        yield np.concatenate([each.reshape(-1, length).mean(axis=1) for each in filled])


def _sensors_in_use(recording: Recording, device: Device, estimator: str) -> Iterator[Sensor]:
    """The channels that an estimator follows. What it cannot use is left to its own message."""
    if estimator in POSITION_ESTIMATORS:
        for name, axis in device.axes.items():
            with suppress(BadInput):
                if recording.channels.keys() & {f"sense_{name}", f"angle_{name}"}:
                    channel = find_position_signal(recording, axis, name)[0]
                    driven = _drive_frequencies(recording, device, name)
                    yield Sensor(channel, (name,), _bands(device, name, driven) if driven else (), True)
    elif estimator in SENSE_ESTIMATORS:
        with suppress(BadInput):
            for sense in sense_channels(recording, device, gaps_ok=True):
                order = 2 if is_capacitive(sense.readout) else 1
                bands = [
                    _bands(device, name, _drive_frequencies(recording, device, name), order) for name in sense.axes
                ]
                used = sum(bands, ()) if all(bands) else ()
                yield Sensor(sense.channel, sense.axes, used, False)


def _drive_frequencies(recording: Recording, device: Device, name: str) -> list[float]:
    """Frequencies at which the drive of an axis moves it [Hz]: of its strongest line near the resonance, and of all."""
    axis, drive = device.axis(name), recording.channels.get(f"drive_{name}")
    if axis.drive is None:
        return []
    ratio, found = axis.drive.motion_per_drive, []
    if drive is None:
        return [] if axis.drive.frequency is None else [axis.drive.frequency * ratio]
    for low in (0.1 * axis.resonance, 0.0) if axis.mechanics else (0.0,):
        with suppress(BadInput):
            found.append(dominant_frequency(drive, low) * ratio)
    return found


def _bands(device: Device, name: str, driven: list[float], order: int = 1) -> tuple[tuple[float, float], ...]:
    """Ranges [Hz] around the resonance and the driven frequencies of an axis, times ``order``, merged."""
    axis = device.axis(name)
    centres = sorted({*driven, axis.resonance} if axis.mechanics else set(driven))
    merged: list[tuple[float, float]] = []
    for low, high in ((BAND[0] * order * centre, BAND[1] * order * centre) for centre in centres):
        if merged and low <= merged[-1][1]:
            merged[-1] = (merged[-1][0], high)
        else:
            merged.append((low, high))
    return tuple(merged)


def _in_words(bands: Sequence[tuple[float, float]]) -> str:
    """Where a line was searched."""
    if not bands:
        return "at all frequencies"
    return (
        "at " + " and ".join(f"{low:.5g} to {high:.5g} Hz" for low, high in bands) + ", where the motion is expected,"
    )


def _alternatives(recording: Recording, device: Device, sensor: Sensor) -> str:
    """Other channels that show the motion, with the estimator that uses them, as the end of a hint."""
    name = sensor.axes[0]
    others = []
    if f"angle_{name}" in recording and not sensor.channel.name.startswith("angle"):
        others.append(f"--estimator sensor uses angle_{name}")
    readout = device.axis(name).readout
    if sensor.channel.name.startswith("angle") and f"sense_{name}" in recording and readout is not None:
        how = "leave out the channel and sensor" if isinstance(readout, Position) else "--estimator tracker"
        others.append(f"{how} uses sense_{name}")
    if f"sync_{name}" in recording.edges:
        others.append(f"--estimator edges uses sync_{name}")
    if all(_drive_frequencies(recording, device, axis) for axis in AXES if axis in device.axes):
        others.append("--estimator picture needs the drives and the intensity alone")
    return f"; or {', '.join(others)}" if others else ""
