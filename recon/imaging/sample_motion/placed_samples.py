"""Samples of a scan with the places of the beam in the picture, in few bytes a sample."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanner.arrays import Array

STEP_PX = 0.01
"""Step of the places that are kept [px]: its rounding, 0.003 px rms, is far below what a block determines."""

MARGIN_PX = 64.0
"""Distance beyond the field up to which places are kept [px]: a motion of the sample brings them into the picture."""


class PlacedSamples(NamedTuple):
    """Samples of a scan, each of shape (n,): place of the beam from the corner of the field, and intensity.

    Places are integers in steps of ``STEP_PX`` from ``-MARGIN_PX`` on: 8 bytes a sample in place of 12.

    Attributes:
        x, y: place [STEP_PX].
        value: intensity; NaN where the place is unknown or beyond the margin.
    """

    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    value: NDArray[np.float32]

    @classmethod
    def empty(cls, size: int) -> PlacedSamples:
        """Return ``size`` samples without values."""
        return cls(np.zeros(size, np.uint16), np.zeros(size, np.uint16), np.full(size, np.nan, np.float32))

    @classmethod
    def from_arrays(cls, x: Array, y: Array, value: Array) -> PlacedSamples:
        """Return samples at places in pixels, arrays of shape (n,)."""
        samples = cls.empty(x.size)
        samples.write(0, x, y, value)
        return samples

    def write(self, first: int, x: Array, y: Array, value: Array) -> None:
        """Write samples at places in pixels, arrays of shape (n,), from sample ``first`` on."""
        part = slice(first, first + value.size)
        steps = [np.rint((each + MARGIN_PX) / STEP_PX) for each in (x, y)]
        inside = np.all([(each >= 0.0) & (each <= np.iinfo(np.uint16).max) for each in steps], axis=0)
        self.x[part], self.y[part] = (np.where(inside, each, 0.0) for each in steps)
        self.value[part] = np.where(inside, value, np.nan)

    def places(self, part: slice | NDArray[np.int64]) -> tuple[Array, Array]:
        """Return the places x and y of some samples [px]."""
        x, y = (np.multiply(each[part], STEP_PX, dtype=np.float64) - MARGIN_PX for each in (self.x, self.y))
        return x, y
