"""Signals whose converter or integer type overflowed: the values continue at the other end of their range."""

from __future__ import annotations

import numpy as np

from scanner.arrays import Array
from scanner.recording import Recording
from scanner.wording import quantity

CHECKED_SAMPLES = 1 << 20
"""Samples from the start that are checked."""

MIN_OVERFLOWS = 10
"""Jumps in either direction from which a signal overflows. The flyback of a raster jumps in one direction only."""

JUMP_SHARE = 0.5
"""Step between two samples, of the whole range, from which it is a jump."""

WRAP_SHARE = 0.75
"""Step, of the whole range, that a jump exceeds if the signal has continued at the other end of the range."""

MIN_WRAP_FRACTION = 0.8
"""Fraction of the jumps that exceed ``WRAP_SHARE``. Pulses of a detector jump by all sizes, few by the whole range."""

MIDDLE_SHARE = 0.25
"""Distance from either end of the range, of the whole range, from which a sample is in its middle."""

MIN_MIDDLE_SAMPLES_PER_JUMP = 1.0
"""Samples in the middle of the range for each jump: a signal reaches the end at which it overflows through the middle,
and returns through it. One that switches between two levels, as bright beads on a dark ground, is not there."""

MIN_LEVELS = 16
"""Different values of a signal that overflows: those of a converter of four bits. Rare photons are counts from 0 to 2,
which jump from one end of this range to the other wherever two arrive at once."""


def describe_overflows(recording: Recording) -> list[str]:
    """A line for each signal of the motion or the light that jumps from one end of its range to the other and back."""
    lines = []
    for name, channel in recording.channels.items():
        if not name.startswith(("sense", "angle_", "intensity")):
            continue
        values = channel.read(0, min(channel.size, CHECKED_SAMPLES))
        for column in values.reshape(len(values), -1).T:
            if jumps := count_overflows(column):
                lines.append(
                    f"{name}: jumps {jumps} times from one end of its range to the other, {np.nanmin(column):.4g} and "
                    f"{quantity(float(np.nanmax(column)), channel.unit)}, and back: its converter or its "
                    "integer type overflows, and the picture is wrong: change gain or type"
                )
    return lines


def count_overflows(values: Array) -> int:
    """Number of jumps of a signal (n,) between the ends of its range; 0 if it does not overflow."""
    finite = values[np.isfinite(values)]
    if not finite.size or np.ptp(finite) == 0.0:
        return 0
    low, high = finite.min(), finite.max()
    steps = np.diff(finite) / (high - low)
    jumps = steps[np.abs(steps) > JUMP_SHARE]
    wraps = jumps[np.abs(jumps) > WRAP_SHARE]
    if min(np.sum(wraps > 0.0), np.sum(wraps < 0.0)) < MIN_OVERFLOWS or wraps.size < MIN_WRAP_FRACTION * jumps.size:
        return 0
    middle = np.abs(finite - 0.5 * (low + high)) < (0.5 - MIDDLE_SHARE) * (high - low)
    if middle.sum() < MIN_MIDDLE_SAMPLES_PER_JUMP * wraps.size or np.unique(finite).size < MIN_LEVELS:
        return 0
    return int(wraps.size)
