"""Signed integers of an intensity that were stored as unsigned ones: dark samples appear brighter than any other.

A baseline that was subtracted from unsigned counts, or a signed converter, puts values just below zero at the upper
end of the type's range. The values are then in two groups, at both ends of it. A scene has values between them.
"""

from __future__ import annotations

import numpy as np

from recon.imaging.wild_samples import MAX_CHECKED_SAMPLES
from scanner.arrays import Array
from scanner.channel import Channel
from scanner.wording import percent

MIN_EMPTY_SHARE = 0.5
"""Share of the type's range between the two groups that holds no value: signed values use less than the other half."""

MAX_END_SHARE = 1.0 / 64.0
"""Share of the range that both groups leave free at its ends: signed values are continuous through zero."""

MIN_VALUES = 8
"""Different values in either group: a saturated detector, or a comparator, has one at the upper end."""


def describe_wrapped_integers(intensity: Channel) -> list[str]:
    """A line if unsigned integers of an intensity are signed ones."""
    if not np.issubdtype(intensity.raw.dtype, np.unsignedinteger):
        return []
    stored = intensity.stored(0, MAX_CHECKED_SAMPLES)
    span = float(np.iinfo(stored.dtype).max) + 1.0
    share = _wrapped_share(stored.astype(np.float64).ravel(), span)
    if share == 0.0:
        return []
    kind = np.dtype(stored.dtype)
    return [
        f"intensity: {percent(share)} of the samples are near the largest value of {kind} and the others near 0, with "
        f"none between: negative values that were stored as {kind}, so that dark places appear brightest; store them "
        f"as {np.dtype(f'i{kind.itemsize}')}"
    ]


def _wrapped_share(values: Array, span: float) -> float:
    """Share of values in the upper of two groups at both ends of a range from 0 to ``span``; 0 without two groups."""
    different = np.unique(values)
    if different.size < 2 * MIN_VALUES:
        return 0.0
    gaps = np.diff(different)
    at = int(np.argmax(gaps))
    lower, upper = at + 1, different.size - at - 1
    across = span - different[-1] + different[0]
    if min(lower, upper) < MIN_VALUES or gaps[at] < MIN_EMPTY_SHARE * span or across > MAX_END_SHARE * span:
        return 0.0
    return float(np.mean(values >= different[at + 1]))
