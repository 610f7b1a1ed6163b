"""Search of a channel for lines above the noise, with the number of frequencies that were searched priced in.

Under the null hypothesis, noise whose spectrum is smooth, the power of a Hann-windowed spectrum at one frequency is
exponentially distributed about the noise level. The level is the median of the surrounding frequencies, so that a ratio
of power to level has an F distribution, which contains the uncertainty of the level. The smallest probability found is
multiplied by the number of powers that were searched (Bonferroni). The frequencies of the drive, at which a driven
motion stands, and the bands around them and around the resonance, where it decays, are two searches, each with half of
the false-alarm probability. The former uses no window and the exact frequency, which costs no sensitivity:
the leakage of other lines is smooth there and raises the level as well.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import ceil

import numpy as np
from scipy.special import fdtrc, gammaincinv

from scanner.arrays import Array
from scanner.channel import Channel

FALSE_ALARM_PROBABILITY = 1e-3
"""Probability that noise alone passes as a motion. A sensor of noise that passes is refused by the estimator or gives a
useless picture; a usable sensor that is refused stops the work. The value is therefore not smaller."""

SURROUNDING = 1.25
"""Factor by which the frequencies whose median is the noise level extend beyond a band on either side."""

PIECE_SAMPLES = 1 << 18
"""Samples that are searched at a time. A line of a sensor that works is found in the first piece."""

SEGMENTS = (1, 4, 16)
"""Numbers of segments of a piece whose spectra are searched, one by one and as their mean: the whole piece is most
sensitive to a steady line, a short segment to one that drifts, begins late or decays."""

SAMPLES_PER_CYCLE = 8
"""Samples per cycle of the highest frequency down to which samples are averaged: 97 % of its amplitude is left."""

MIN_SEGMENT_SAMPLES = 32
"""Fewest samples of a spectrum: fewer have no ``MIN_LEVEL_ORDINATES`` frequencies."""

LEVEL_ORDINATES = 256
"""Frequencies whose median is one noise level: it is then known to 13 %, and coloured noise is flat across them."""

MIN_LEVEL_ORDINATES = 16
"""Fewest frequencies that give a noise level. With fewer, a line 100 times above the noise is no proof of a motion."""

LEVEL_EFFICIENCY = 0.247
"""Independent mean powers that are as accurate as the median of one: ln(2)^2 for the median of an exponential
distribution, times 18/35 for the correlation of neighbouring powers under a Hann window."""

READ_SAMPLES = 1 << 20
"""Samples that are read at a time while they are averaged, which bounds the memory."""


@dataclass(frozen=True)
class LineSearch:
    """Result of a search for lines.

    Attributes:
        found: whether a line exceeds the noise with a false-alarm probability below ``FALSE_ALARM_PROBABILITY``.
        frequency: of the strongest line in the spectrum of one piece [Hz].
        ratio: its power over the noise around it.
        needed: this ratio from which a steady line is found.
        driven: largest such ratio at the drives' frequencies; None without a drive.
    """

    found: bool
    frequency: float
    ratio: float
    needed: float
    driven: float | None = None


def search_lines(
    channel: Channel, bands: Sequence[tuple[float, float]], driven: Sequence[float] = ()
) -> LineSearch | None:
    """Search a channel for lines, piece by piece until one is found.

    Args:
        channel: samples that are not finite count as the mean.
        bands: lowest and highest frequency of each range to search [Hz]; all frequencies if empty.
        driven: frequencies within the bands of which a line is most probable [Hz].

    Returns:
        The result of the piece with the line, else of the first piece; None if the channel is too short or too slow to
        determine a noise level, holds too few cycles of one of the bands, or is constant.
    """
    first: LineSearch | None = None
    lengths = _averaging_lengths(channel, bands)
    pieces = sum(max(1, ceil(channel.size // length / PIECE_SAMPLES)) for length in lengths)
    for length in lengths:
        rate = channel.sample_rate / length
        used = [(low, min(high, 0.5 * rate)) for low, high in bands or [(0.0, 0.5 * rate)]]
        for values in _pieces(channel, length):
            result = _search_piece(values, rate, used, driven, FALSE_ALARM_PROBABILITY / pieces)
            if result is not None and result.found:
                return result
            first = first or result
    return first


def _search_piece(
    values: Array, rate: float, bands: Sequence[tuple[float, float]], driven: Sequence[float], false_alarm: float
) -> LineSearch | None:
    """Search one piece of samples; None if it determines no noise level, or is too short for one of the bands."""
    in_bands, at_lines, skipped = _Search(), _Search(), False
    if not np.ptp(values) > 0.0:
        return None
    for segments in SEGMENTS:
        length = values.size // segments
        if length < MIN_SEGMENT_SAMPLES:
            continue
        parts = values[: length * segments].reshape(segments, length)
        parts = parts - parts.mean(axis=1, keepdims=True)
        windowed = np.square(np.abs(np.fft.rfft(parts * np.hanning(length), axis=1)))
        plain = np.square(np.abs(np.fft.rfft(parts, axis=1))) if driven else windowed
        frequency = np.arange(windowed.shape[1], dtype=np.float64) * (rate / length)
        for low, high in bands:
            around = _rows(frequency, low / SURROUNDING, high * SURROUNDING)
            around = slice(around.start, min(max(around.stop, around.start + MIN_LEVEL_ORDINATES), frequency.size - 1))
            near, inside = frequency[around], slice(*np.searchsorted(frequency[around], (low, high)))
            if near.size < MIN_LEVEL_ORDINATES or inside.stop <= inside.start:
                skipped |= segments == 1 and low < frequency[-1]
                continue
            lines = np.array([line for line in driven if low <= line <= high])
            at = np.clip(np.searchsorted(near, lines), 0, near.size - 1)
            exact = np.square(np.abs(parts @ np.exp(-2j * np.pi / rate * np.outer(np.arange(length), lines))))
            for count in sorted({1, segments}):
                powers, unwindowed, line_powers = (_means(each, count) for each in (windowed, plain, exact))
                level, equivalent = _noise_level(powers[:, around], count)
                in_bands.add((powers[:, around] / level)[:, inside], near[inside], count, equivalent)
                if lines.size:
                    level, equivalent = _noise_level(unwindowed[:, around], count)
                    at_lines.add(line_powers / level[:, at], lines, count, equivalent)
    if in_bands.steady is None:
        return None
    searches = [search for search in (in_bands, at_lines) if search.number]
    each = false_alarm / len(searches)
    strongest, line, equivalent = in_bands.steady
    found = any(search.lowest * search.number < each for search in searches)
    if skipped and not found:
        return None
    return LineSearch(
        found=found,
        frequency=line,
        ratio=strongest,
        needed=equivalent * ((each / in_bands.number) ** (-1.0 / equivalent) - 1.0),
        driven=at_lines.steady[0] if at_lines.steady else None,
    )


@dataclass
class _Search:
    """The lowest probability among the powers searched so far.

    Attributes:
        lowest: probability that noise exceeds the most improbable power. number: of powers that were searched.
        steady: (ratio, frequency [Hz], mean powers of the level) of the strongest line over the whole piece.
    """

    lowest: float = 1.0
    number: int = 0
    steady: tuple[float, float, float] | None = None

    def add(self, ratio: Array, frequency: Array, count: int, equivalent: float) -> None:
        """Add ratios of means of ``count`` spectra to their noise level, shape (spectra, frequencies)."""
        probability = fdtrc(2 * count, 2 * count * equivalent, ratio)
        self.lowest, self.number = min(self.lowest, float(probability.min())), self.number + probability.size
        if count == 1 and len(ratio) == 1:
            at = int(ratio[0].argmax())
            found = (float(ratio[0, at]), float(frequency[at]), equivalent)
            self.steady = max(self.steady or found, found)


def _means(powers: Array, count: int) -> Array:
    """Means of ``count`` spectra: the spectra themselves, or the mean of them all."""
    return powers if count == 1 else powers.mean(axis=0)[None]


def _rows(frequency: Array, low: float, high: float) -> slice:
    """The frequencies from ``low`` to ``high``, without the lowest two and the highest, which the window disturbs."""
    first, stop = np.searchsorted(frequency, (low, high))
    return slice(max(int(first), 2), max(min(int(stop), frequency.size - 1), 2))


def _noise_level(powers: Array, count: int) -> tuple[Array, float]:
    """Noise level at each frequency, interpolated between the medians of groups of frequencies.

    Args:
        powers: means of ``count`` spectra, shape (spectra, frequencies).
        count: number of spectra in each mean.

    Returns:
        (levels, of the shape of ``powers``; mean powers that determine a level as well as its median does).
    """
    at = np.arange(powers.shape[1])
    groups = np.array_split(at, max(1, at.size // LEVEL_ORDINATES))
    median_of_one = gammaincinv(count, 0.5) / count
    levels = np.stack([np.median(powers[:, group], axis=1) for group in groups], axis=1) / median_of_one
    centres = [float(group.mean()) for group in groups]
    interpolated = np.stack([np.interp(at, centres, each) for each in levels])
    return np.maximum(interpolated, np.finfo(float).tiny), LEVEL_EFFICIENCY * groups[-1].size


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
