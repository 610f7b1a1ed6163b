"""A drive that was recorded during a part of its sense signal only.

Before and after its record the drive was off, or it continued: an oscilloscope was triggered late, or its memory was
full. The record is extended by 0 V, as a drive that is off. ``drive_consistency`` then tests these ends by the motion,
as every pause of a drive, and continues the drive where the motion contradicts that it was off.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimation.signals import SenseChannel
from scanner.channel import Channel, LazySamples
from scanner.recording import Recording

MIN_COVERED_SHARE = 0.1
"""Part of the sense signal that a drive has to cover to be extended: the error of its phase grows with the
distance from the record over the length of it."""


def with_whole_drives(recording: Recording, sense: Channel, axes: Sequence[str]) -> Recording:
    """The recording with drives that cover the sense signal, by 0 V where they were not recorded.

    Args:
        recording: with the drives.
        sense: the signal of the motion.
        axes: that the signal shows.
    """
    for name in axes:
        drive = recording.channels.get(f"drive_{name}")
        if drive is None:
            continue
        before, after = missing_samples(drive, sense)
        covered = min(drive.end, sense.end) - max(drive.start, sense.start)
        if (before or after) and covered >= MIN_COVERED_SHARE * (sense.end - sense.start):
            recording = recording.with_channel(_extended(drive, before, after))
    return recording


def missing_samples(drive: Channel, sense: Channel) -> tuple[int, int]:
    """Samples that a drive lacks before and after its record to cover a sense signal."""
    before = np.ceil((drive.start - sense.start) * drive.sample_rate - 0.5)
    after = np.ceil((sense.end - drive.end) * drive.sample_rate - 0.5)
    return max(int(before), 0), max(int(after), 0)


def describe_pauses(
    recorded: Recording, whole: Recording, sense: SenseChannel, contradicted: Mapping[str, Sequence[tuple[int, int]]]
) -> list[str]:
    """A line for each drive that was recorded in part, and for each whose recorded pauses the motion contradicts.

    Args:
        recorded, whole: with the drives as recorded, and as of ``with_whole_drives``.
        sense: the signal of the motion.
        contradicted: ranges (first, stop) of samples of the whole drives in which the mirror was driven, by axis.
    """
    lines = []
    for name in sense.axes:
        drive = recorded.channels.get(f"drive_{name}")
        if drive is None:
            continue
        longer, pauses = whole[f"drive_{name}"], contradicted.get(name, ())
        before, after = missing_samples(drive, sense.channel) if longer is not drive else (0, 0)
        outside = [pause for pause in pauses if pause[0] < before or pause[1] > longer.size - after]
        inside = [pause for pause in pauses if pause not in outside]
        if before or after:
            lines.append(_describe_ends(drive, sense.channel, name, bool(outside)))
        if inside:
            lines.append(_describe_pauses(longer, sense.channel, name, inside))
    return lines


def _describe_ends(drive: Channel, sense: Channel, axis: str, driven: bool) -> str:
    """The line on a drive that was recorded during a part of the sense signal only."""
    line = f"{drive.name}: was recorded from {drive.start:.4g} s to {drive.end:.4g} s, {sense.name} from "
    line += f"{sense.start:.4g} s to {sense.end:.4g} s, which shows that {axis} was "
    if driven:
        return line + "driven outside of the record: the drive is assumed to continue there with its last frequency"
    return line + "not driven outside of the record, or too little to show it: the drive is assumed to be off there"


def _describe_pauses(drive: Channel, sense: Channel, axis: str, pauses: Sequence[tuple[int, int]]) -> str:
    """The line on the pauses of one drive that the motion contradicts."""
    duration = sum(stop - first for first, stop in pauses) / drive.sample_rate
    places = "one interval" if len(pauses) == 1 else f"{len(pauses)} intervals"
    return (
        f"{drive.name}: is recorded as off for about {1e3 * duration:.2g} ms in {places}, the first at "
        f"{drive.start + pauses[0][0] / drive.sample_rate:.4g} s, and {sense.name} shows that {axis} was driven there: "
        "this part of the record is not used, and the drive is assumed to have continued; check the buffer of the "
        "generator (underrun) and the cable of this channel"
    )


def _extended(drive: Channel, before: int, after: int) -> Channel:
    """The drive with ``before`` and ``after`` samples of 0 V beside its record."""
    size, total = drive.size, before + drive.size + after

    def fetch(first: int, stop: int) -> NDArray[np.float64]:
        values = np.zeros(stop - first)
        low, high = max(first, before), min(stop, before + size)
        if low < high:
            values[low - first : high - first] = drive.read(low - before, high - before)
        return values

    raw = LazySamples((total,), np.dtype(np.float64), fetch)
    start = drive.start - before / drive.sample_rate
    return replace(drive, raw=raw, first=0, stop=total, start=start, gain=1.0, offset=0.0)
