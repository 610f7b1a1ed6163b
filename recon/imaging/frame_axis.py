"""The axis along which the frames of a scan follow one another: time, or the position z of a stack."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

MAX_UNEVENNESS = 0.1
"""Largest distance of a slice from an even spacing, in steps, up to which a stack is stored as evenly spaced: the noise
of a position sensor is below it, and a slice moved by it is not visibly displaced."""


@dataclass(frozen=True)
class FrameAxis:
    """Time or position of each frame.

    Attributes:
        name: ``"t"`` or ``"z"``.
        values: beginning of each frame [s], or position of each slice, increasing [m]; numbers of repeats whose times
            are unknown.
        step: from one frame to the next, the mean for slices [s] or [m]; NaN for a single slice and unknown times.
    """

    name: Literal["t", "z"]
    values: Sequence[float]
    step: float

    @property
    def timed(self) -> bool:
        """Whether the times of frames are known."""
        return self.name == "t" and not np.isnan(self.step)

    @property
    def even(self) -> bool:
        """Whether the frames are evenly spaced; False for a single slice, which has no spacing."""
        if self.name == "t":
            return True
        spaced = self.values[0] + self.step * np.arange(len(self.values))
        return bool(np.all(np.abs(np.asarray(self.values) - spaced) <= MAX_UNEVENNESS * self.step))


def position_axis(positions: Sequence[float]) -> FrameAxis:
    """Return the axis of slices at increasing positions [m]."""
    step = (positions[-1] - positions[0]) / (len(positions) - 1) if len(positions) > 1 else float("nan")
    return FrameAxis("z", positions, step)


def format_positions(positions: Sequence[float]) -> list[str]:
    """Return positions [m] as texts in µm that distinguish each from the next."""
    gaps = np.diff(positions)
    finest = 1e6 * float(gaps.min()) if gaps.size else 0.1
    digits = int(np.clip(1 - np.floor(np.log10(finest)), 0, 6))
    return [f"{1e6 * position:.{digits}f}" for position in positions]
