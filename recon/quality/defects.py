"""Defects of a recording that a reconstruction can tolerate: missing and clipped samples, and where they matter."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimation.held_samples import find_held_runs, slowest_motions
from scanner.angle_tracks import AngleTrack
from scanner.channel import MIN_CLIPPED_RUN_SAMPLES, READ_CHUNK_SAMPLES, Channel
from scanner.device import Device
from scanner.motion import Motion
from scanner.recording import Recording
from scanner.sample_ranges import SampleRanges, merge_ranges, runs_of_true, subtract_ranges, to_sample_ranges
from scanner.wording import percent

MERGE_GAP_S = 1e-3
"""Intervals of one kind that are closer than this are reported as one: a signal that clips clips in every period."""

MAX_STATED_FRACTION = 0.995
"""Fraction of affected samples in an interval up to which it is stated: larger ones read as 1 with two digits."""

MAX_PHASE_SD_RAD = 0.25
"""Standard deviation of the phase above which a sample gets no pixel. It corresponds to 50 pixels of 400."""

EXTRAPOLATION_BLOCKS = 2.0
"""Blocks of the slow motion beyond its first and last one over which its phase is extrapolated."""

MAX_CLIPPED_SHARE = 0.01
"""Share of clipped samples of a position signal from which the picture is wrong. A sine that is clipped at both peaks
for so long loses 1.2e-4 of its amplitude, 0.02 of 400 pixels."""

MIN_RAIL_RUN_SAMPLES = 2
"""Length of a run of equal samples at an extreme value from which it may be of a rail, if such runs hold more than
``MAX_CLIPPED_SHARE`` of the samples: a signal of 25 samples a period that is clipped at 0.9 of its amplitude has runs
of three and four. Else ``MIN_CLIPPED_RUN_SAMPLES`` are needed, as chance makes short runs [samples]."""

MAX_LEVEL_RATIO = 4.0
"""Samples at the largest value of a converter over those at the value next to it up to which it is no rail. The peak of
a sine that is not clipped has up to 2.4 times as many; one that is cut by a step of the converter has 4.4."""

ESTIMATORS_WITHOUT_GAPS = ("ekf", "ukf", "hyb", "acm", "sine-ukf", "constant")
"""Estimators that follow a sense signal sample by sample. The others leave held samples out."""

PHASE_JUMP = "leap"
"""Kind of a phase jump. summary.json contains this text, and programs that read it depend on it."""

HELD = "held"
"""Kind of an interval in which a signal of the motion stands at one value for a period or longer."""

LOST = "lost"
"""Kind of an interval in which a position signal shows no motion and the intensity shows one."""

KIND_NAMES = {PHASE_JUMP: "phase jump", HELD: "held at one value", LOST: "no motion, while the light shows one,"}
"""Names of kinds in messages, where they differ from the text in summary.json."""


@dataclass(frozen=True)
class Defect:
    """An interval of one channel that cannot be used as it is.

    Attributes:
        channel: name of the channel.
        kind: ``"gap"`` (samples that are not finite), ``HELD``, ``LOST``, ``"clipped"``, ``"missing"`` (the channel
            begins later or ends earlier than the intensity) or ``PHASE_JUMP`` (see :mod:`recon.quality.clock_jumps`; of
            the intensity, see :mod:`recon.quality.dropped_samples`).
        start, stop: [s] on the recording's clock.
        fraction: of the samples in the interval that are affected.
    """

    channel: str
    kind: str
    start: float
    stop: float
    fraction: float = 1.0


def find_defects(recording: Recording, device: Device, recorded: Channel | None = None) -> list[Defect]:
    """Return gaps, held values, clipping and missing parts of the channels that a picture is made of.

    Args:
        recording: with an intensity.
        device: of the recording; it states how long a signal of the motion can stand at one value.
        recorded: the intensity as it was recorded, whose time the others are to cover; that of ``recording`` where
            None. A correction for a late detector moves the intensity to times before the recording.

    Returns:
        The defects channel by channel, those of one kind in order of time.
    """
    intensity = recording["intensity"]
    defects: list[Defect] = []
    slowest = slowest_motions(recording, device)
    for name, channel in recording.channels.items():
        if name.startswith(("sense", "drive_", "angle_")) or name == "intensity":
            if name != "intensity":
                defects += _find_missing_ends(channel, recorded or intensity)
            defects += _as_defects(channel, "gap", _find_gaps(channel))
            held = find_held_runs(channel, slowest[name]) if name in slowest else []
            defects += _as_defects(channel, HELD, held)
            if name.startswith("sense"):
                defects += _as_defects(channel, "clipped", subtract_ranges(_find_clipped_runs(channel), held))
    return defects


def unrecoverable_intervals(motion: Motion, defects: Sequence[Defect]) -> list[tuple[float, float]]:
    """Return the intervals [s] of defects in which the mirror's angle is unknown: their samples belong to no pixel.

    The angle is unknown where the phase has a standard deviation above ``MAX_PHASE_SD_RAD``, and beyond the ends of
    the slow motion. Defects of the intensity leave the angle known.
    """
    unknown = []
    for axis in motion.axes.values():
        half_block = 0.5 * float(axis.time[1] - axis.time[0])
        margin = 2 * EXTRAPOLATION_BLOCKS * half_block
        unknown += [(-np.inf, float(axis.time[0]) - margin), (float(axis.time[-1]) + margin, np.inf)]
        known = np.nan_to_num(axis.phase_sd, nan=np.inf) <= MAX_PHASE_SD_RAD
        unknown += [
            (float(axis.time[first]) - half_block, float(axis.time[stop - 1]) + half_block)
            for first, stop in runs_of_true(~known)
        ]
    return [
        (max(low, defect.start), min(high, defect.stop))
        for defect in defects
        if defect.channel != "intensity"
        for low, high in unknown
        if max(low, defect.start) < min(high, defect.stop)
    ]


def unlocated_samples(motion: Motion, beam: Motion, defects: Sequence[Defect], intensity: Channel) -> SampleRanges:
    """Return the samples of the intensity during which the mirror's angle is unknown.

    Args:
        motion, defects: as for :func:`unrecoverable_intervals`.
        beam: the motion as the light shows it, on the intensity's clock.
        intensity: of the recording.
    """
    unknown = to_sample_ranges(unrecoverable_intervals(motion, defects), intensity)
    unknown += [each for axis in beam.axes.values() for each in _unknown_angles(axis.angle)]
    return [(first, stop) for first, stop in merge_ranges(sorted(unknown), 0)]


def _unknown_angles(track: AngleTrack) -> Iterator[tuple[int, int]]:
    """Yield ranges of samples at which a track holds no angle; synthesised ones hold one everywhere."""
    for first in range(0, track.size, READ_CHUNK_SAMPLES) if track.phasors() is None else ():
        unknown = np.isnan(track.read(first, first + READ_CHUNK_SAMPLES))
        yield from ((first + low, first + high) for low, high in runs_of_true(unknown))


def describe_defects(defects: Sequence[Defect]) -> Iterator[str]:
    """Yield a line of text for each channel and kind of defect."""
    for (channel, kind), group in groupby(defects, lambda defect: (defect.channel, defect.kind)):
        same = list(group)
        # A sense signal of two axes may jump at both of their lines at one time.
        intervals = merge_ranges(sorted((defect.start, defect.stop) for defect in same), 0.0)
        total = sum(stop - start for start, stop in intervals)
        places = "one interval" if len(intervals) == 1 else f"{len(intervals)} intervals"
        name = KIND_NAMES.get(kind, kind)
        fraction = sum(defect.fraction * (defect.stop - defect.start) for defect in same)
        fraction /= sum(defect.stop - defect.start for defect in same)
        share = "" if fraction > MAX_STATED_FRACTION else f", {percent(fraction)} of the samples there"
        yield f"{channel}: {name} for {1e3 * total:.4g} ms in {places}, the first at {intervals[0][0]:.6g} s{share}"


def describe_clipped_positions(defects: Sequence[Defect], motion: Motion, duration: float) -> list[str]:
    """A line for each position signal that clips while the estimator takes its samples for the angle.

    Args:
        defects: of the recording.
        motion: with the estimator's name.
        duration: of the recording [s].
    """
    if motion.estimator != "sensor":
        return []
    shares: dict[str, float] = {}
    for each in defects:
        if each.kind == "clipped" and each.channel.startswith("sense"):
            shares[each.channel] = shares.get(each.channel, 0.0) + each.fraction * (each.stop - each.start) / duration
    return [
        f"{name}: is clipped in {share:.0%} of the samples, which the estimator sensor takes for angles: the picture "
        "is wrong beyond that angle; lower the amplifier's gain, or use --estimator tracker, which needs the mechanics"
        for name, share in shares.items()
        if share > MAX_CLIPPED_SHARE
    ]


def describe_held_signals(defects: Sequence[Defect], motion: Motion) -> list[str]:
    """A line for each held signal of the motion whose estimator does not leave the held samples out.

    Args:
        defects: of the recording.
        motion: with the estimator's name.
    """
    if motion.estimator not in ESTIMATORS_WITHOUT_GAPS:
        return []
    held: dict[str, list[Defect]] = {}
    for each in defects:
        if each.kind == HELD:
            held.setdefault(each.channel, []).append(each)
    return [
        f"{name}: stands at one value for {1e3 * sum(each.stop - each.start for each in same):.4g} ms, the first time "
        f"at {same[0].start:.6g} s, as a sensor or a converter that was stopped; the estimator {motion.estimator} "
        "takes the value for the motion, and the picture is wrong there; use --estimator tracker, or cut the recording"
        for name, same in held.items()
    ]


def _find_missing_ends(channel: Channel, intensity: Channel) -> list[Defect]:
    """The parts of the intensity's time that the channel does not cover."""
    tolerance = 2.0 / min(channel.sample_rate, intensity.sample_rate)
    ends = ((intensity.start, channel.start), (channel.end, intensity.end))
    return [Defect(channel.name, "missing", start, stop) for start, stop in ends if stop - start > tolerance]


def _as_defects(channel: Channel, kind: str, ranges: SampleRanges) -> list[Defect]:
    """Ranges of samples as defects of one kind, merged where they are close together."""
    rate, start = channel.sample_rate, channel.start
    affected = np.concatenate([[0], np.cumsum([stop - first for first, stop in ranges], dtype=int)])
    ends = np.array([stop for _, stop in ranges])
    defects, before = [], 0
    for first, stop in merge_ranges(ranges, round(MERGE_GAP_S * rate)):
        after = int(np.searchsorted(ends, stop, "right"))
        fraction = float(affected[after] - affected[before]) / (stop - first)
        defects.append(Defect(channel.name, kind, start + first / rate, start + stop / rate, fraction))
        before = after
    return defects


def _read_chunks(channel: Channel) -> Iterator[tuple[int, NDArray[Any]]]:
    """First sample and stored values of every chunk. Gaps and clipping show in them, and they are fast to read."""
    for first in range(0, channel.size, READ_CHUNK_SAMPLES):
        yield first, channel.stored(first, first + READ_CHUNK_SAMPLES)


def _find_gaps(channel: Channel) -> SampleRanges:
    """Samples that are not finite, in any detector."""
    if channel.raw.dtype.kind != "f":
        return []
    gaps: SampleRanges = []
    for first, values in _read_chunks(channel):
        bad = ~np.isfinite(values)
        if bad.any():
            gaps += [(first + a, first + b) for a, b in runs_of_true(bad.reshape(len(bad), -1).any(axis=1))]
    return gaps


def _find_clipped_runs(channel: Channel) -> SampleRanges:
    """Runs of equal samples at the smallest and the largest finite value of the channel, where these are rails.

    The steps of a converter give such runs at the peaks of a sine too, which are left out.
    """
    extremes = [np.inf, -np.inf]
    clipped: tuple[SampleRanges, SampleRanges] = ([], [])
    for first, values in _read_chunks(channel):
        finite = values[np.isfinite(values)]
        if not finite.size:
            continue
        for side, find_extreme, is_beyond in ((0, np.min, np.less), (1, np.max, np.greater)):
            extreme = float(find_extreme(finite))
            if is_beyond(extreme, extremes[side]):
                extremes[side] = extreme
                clipped[side].clear()
            at_extreme = values == extremes[side]
            if np.count_nonzero(at_extreme) >= MIN_RAIL_RUN_SAMPLES:
                clipped[side].extend(
                    (first + a, first + b) for a, b in runs_of_true(at_extreme) if b - a >= MIN_RAIL_RUN_SAMPLES
                )
    rails = [
        side for side in (0, 1) if clipped[side] and _is_rail(channel, extremes[side], (np.less, np.greater)[side])
    ]
    return sorted(run for side in rails for run in _rail_runs(clipped[side], channel.size))


def _rail_runs(runs: SampleRanges, samples: int) -> SampleRanges:
    """The runs at one extreme of a channel of ``samples`` that are too long, or too many, for chance."""
    if sum(stop - first for first, stop in runs) > MAX_CLIPPED_SHARE * samples:
        return runs
    return [(first, stop) for first, stop in runs if stop - first >= MIN_CLIPPED_RUN_SAMPLES]


def _is_rail(channel: Channel, extreme: float, is_beyond: Callable[[float, float], bool]) -> bool:
    """Whether more samples stand at an extreme value than at the peaks of a sine in steps of a converter.

    Args:
        channel: with the signal.
        extreme: its largest or smallest stored value.
        is_beyond: whether a value is nearer to the extreme than another.
    """
    nearest, at_nearest, at_extreme = np.nan, 0, 0
    for _, values in _read_chunks(channel):
        at_extreme += int(np.count_nonzero(values == extreme))
        inside = values[np.isfinite(values) & (values != extreme)]
        if not inside.size:
            continue
        value = float(inside.max() if is_beyond(1.0, 0.0) else inside.min())
        if np.isnan(nearest) or is_beyond(value, nearest):
            nearest, at_nearest = value, 0
        at_nearest += int(np.count_nonzero(inside == nearest))
    return at_extreme > MAX_LEVEL_RATIO * at_nearest
