"""Gaussian smoothing of pictures, and of samples into pixels that hold none."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.arrays import Array

REACH = 4.0
"""Reach of the kernel in standard deviations. A pixel without a sample within it has no value."""

MIN_WIDTH_BLOCKS = 3.0
"""Least standard deviation of a Gaussian on blocks of pixels, in blocks: linear interpolation between them errs by 1 %
of its peak."""

BLOCK_VARIANCE = 0.25
"""Variance that the mean over a block, 1/12, and the interpolation between blocks, 1/6, add [square of a block]."""


def smooth(image: NDArray[Any], width: float) -> Array:
    """Return the image, shape (height, width) or (height, width, n), under a Gaussian; its edges are mirrored.

    A wide Gaussian acts on means over blocks of pixels, and the result is interpolated linearly between them.
    """
    import cv2

    values: Any = image.astype(np.float32)
    height, across = image.shape[:2]
    block = 2 ** int(max(np.log2(max(width, MIN_WIDTH_BLOCKS) / MIN_WIDTH_BLOCKS), 0.0))
    if block > 1:
        blocks = -(-across // block), -(-height // block)
        values = cv2.resize(values, blocks, interpolation=cv2.INTER_AREA)
        width = float(np.sqrt((width / block) ** 2 - BLOCK_VARIANCE))
    size = 2 * max(int(REACH * width + 0.5), 1) + 1
    values = cv2.GaussianBlur(values, (size, size), width, borderType=cv2.BORDER_REFLECT)
    values = cv2.resize(values, (across, height)) if block > 1 else values
    return np.asarray(values).reshape(image.shape)


def kernel_mean(sums: Array, counts: Array, width: float) -> Array:
    """Return the kernel-weighted mean of the samples; where none is in reach, the mean of all."""
    total, weight = np.moveaxis(smooth(np.dstack([sums, counts]), width), -1, 0)
    return mean_of_weighted(total, weight, sums.sum() / counts.sum())


def mean_of_weighted(total: Array, weight: Array, otherwise: float) -> Array:
    """Return the ratio of weighted sums and their weights, or a fixed value where the weight is not positive."""
    return np.where(weight > 0, total / np.maximum(weight, 1e-30), otherwise)


def centre_weight(width: float) -> float:
    """Return the weight of the centre of the kernel of :func:`smooth`."""
    import cv2

    return float(cv2.getGaussianKernel(2 * max(int(REACH * width + 0.5), 1) + 1, width).max() ** 2)
