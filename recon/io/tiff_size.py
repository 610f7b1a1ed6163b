"""The form of a TIFF file by its size: classic TIFF has offsets of 32 bits, BigTIFF of 64 bits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

MAX_CLASSIC_TIFF_BYTES = (1 << 32) - (1 << 25)
"""Pixels of more bytes are written as BigTIFF; the margin is for the descriptions of the pages."""


def needs_bigtiff(shape: Sequence[int], dtype: np.dtype[Any] | type) -> bool:
    """Whether pixels of this shape and type need BigTIFF; tifffile finds out by itself only for an array in memory."""
    return math.prod(shape) * np.dtype(dtype).itemsize > MAX_CLASSIC_TIFF_BYTES
