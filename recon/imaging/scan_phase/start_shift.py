"""A start of the intensity or the ranges, other than the stated one, that explains why they contradict both axes.

A phase is contradicted up to whole half-periods, so that one axis determines no start. Two axes with different periods
test a start that is proposed: that of the phases themselves, or one at which the channel ends with the sensors, as
after a trigger that started it late.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import pi

import numpy as np

from recon.imaging.scan_phase.phase_agreement import Contradiction
from recon.imaging.scan_phase.phase_search import PHASE_CELLS
from scanner.channel import Channel
from scanner.device import AXES
from scanner.motion import Motion
from scanner.recording import Recording

TOLERANCE_RAD = 2.0 * 2.0 * pi / PHASE_CELLS
"""Distance of a phase from that of a proposed start up to which they agree: two cells of the comparison. Both axes
agree by chance with one start in a hundred that is proposed from the lengths of the channels."""

START_DECIMALS = 7
"""Decimals of a start [s] that is stated: phases in cells determine microseconds."""

SENSORS = ("sense", "angle_", "drive_")
"""Beginnings of the names of channels that are recorded beside the intensity or the ranges."""


def describe_start_shift(
    recording: Recording, motion: Motion, found: Sequence[Contradiction], name: str = "intensity"
) -> list[str]:
    """A line on the start of a channel that explains the contradictions of both axes, if one does.

    Args:
        recording: with the unmodified channel.
        motion: of the mirror.
        found: contradictions of the axes by the channel.
        name: of the channel, "intensity" or "range".
    """
    if {each.axis for each in found} != set(AXES):
        return []
    moved = recording[name]
    for shift, reason in _proposed_shifts(recording, moved, motion, found):
        if all(_explains(shift, each, motion) for each in found):
            start = round(moved.start + shift, START_DECIMALS)
            return [
                f"{name}: a start of {start:.6g} s in place of {moved.start:.6g} s explains the disagreement in "
                f"both axes{reason}; if it is right, state it as start of {name}"
            ]
    return []


def _proposed_shifts(
    recording: Recording, moved: Channel, motion: Motion, found: Sequence[Contradiction]
) -> Iterator[tuple[float, str]]:
    """Changes of the start [s], each with a reason beside the phases."""
    slowest = min(found, key=lambda each: _frequency(motion, each.axis))
    yield _phase(slowest) / (2.0 * pi * _frequency(motion, slowest.axis)), ""
    for name, channel in recording.channels.items():
        same_clock = (channel.sample_rate, channel.start) == (moved.sample_rate, moved.start)
        missing = channel.size - moved.size
        if name.startswith(SENSORS) and same_clock and missing:
            yield missing / moved.sample_rate, f", and {moved.name} then ends with {name}"


def _explains(shift: float, found: Contradiction, motion: Motion) -> bool:
    """Whether a change of the start [s] gives the phase at which the picture agrees, up to half-periods."""
    distance = _phase(found) - 2.0 * pi * _frequency(motion, found.axis) * shift
    return abs((distance + 0.5 * pi) % pi - 0.5 * pi) <= TOLERANCE_RAD


def _frequency(motion: Motion, axis: str) -> float:
    return float(np.median(motion.axes[axis].frequency))


def _phase(found: Contradiction) -> float:
    """Mean phase of a contradiction, up to half-periods [rad]."""
    return float(np.angle(np.mean(np.exp(2j * np.array(found.phases))))) / 2.0
