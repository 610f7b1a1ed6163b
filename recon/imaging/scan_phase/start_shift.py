"""A start of the intensity, other than the stated one, that explains why the picture contradicts both axes.

A phase is contradicted up to whole half-periods, so that one axis determines no start. Two axes with different periods
test a start that is proposed: that of the phases themselves, or one at which the intensity ends with the sensors, as
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
"""Beginnings of the names of channels that are recorded beside the intensity."""


def describe_start_shift(recording: Recording, motion: Motion, found: Sequence[Contradiction]) -> list[str]:
    """A line on the start of the intensity that explains the contradictions of both axes, if one does.

    Args:
        recording: with the intensity as it was recorded.
        motion: of the mirror.
        found: contradictions of the axes.
    """
    if {each.axis for each in found} != set(AXES):
        return []
    intensity = recording["intensity"]
    for shift, reason in _proposed_shifts(recording, intensity, motion, found):
        if all(_explains(shift, each, motion) for each in found):
            start = round(intensity.start + shift, START_DECIMALS)
            return [
                f"intensity: a start of {start:.6g} s in place of {intensity.start:.6g} s explains the disagreement in "
                f"both axes{reason}; if it is right, state it as start of the intensity"
            ]
    return []


def _proposed_shifts(
    recording: Recording, intensity: Channel, motion: Motion, found: Sequence[Contradiction]
) -> Iterator[tuple[float, str]]:
    """Changes of the start [s], each with a reason beside the phases."""
    slowest = min(found, key=lambda each: _frequency(motion, each.axis))
    yield _phase(slowest) / (2.0 * pi * _frequency(motion, slowest.axis)), ""
    for name, channel in recording.channels.items():
        same_clock = (channel.sample_rate, channel.start) == (intensity.sample_rate, intensity.start)
        missing = channel.size - intensity.size
        if name.startswith(SENSORS) and same_clock and missing:
            yield missing / intensity.sample_rate, f", and the intensity then ends with {name}"


def _explains(shift: float, found: Contradiction, motion: Motion) -> bool:
    """Whether a change of the start [s] gives the phase at which the picture agrees, up to half-periods."""
    distance = _phase(found) - 2.0 * pi * _frequency(motion, found.axis) * shift
    return abs((distance + 0.5 * pi) % pi - 0.5 * pi) <= TOLERANCE_RAD


def _frequency(motion: Motion, axis: str) -> float:
    return float(np.median(motion.axes[axis].frequency))


def _phase(found: Contradiction) -> float:
    """Mean phase of a contradiction, up to half-periods [rad]."""
    return float(np.angle(np.mean(np.exp(2j * np.array(found.phases))))) / 2.0
