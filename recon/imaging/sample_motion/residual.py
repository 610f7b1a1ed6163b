"""Motion of the sample that was not followed, from two halves of the scene.

The squares of a chessboard are compared with the picture separately. A displacement that is left acts on the squares of
both colours alike, while their noise and unresolved detail are independent. The mean product of both scores is
therefore that of the displacement alone.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from recon.imaging.sample_motion.block_equations import SHAPES, block_equations
from recon.imaging.sample_motion.placed_samples import PlacedSamples
from scanner.arrays import Array
from scanner.channel import READ_CHUNK_SAMPLES

SQUARE_PX = 32.0
"""Side of the squares [px]: many times the widest kernel, 4 px, and an eighth of a picture of 256 pixels."""

MIN_STANDARD_SCORE = 3.9
"""Mean product of the scores in its standard deviations from which a motion is left: chance exceeds it with a
probability of 5e-5, as for a motion that is reported."""


def remaining_motion_variance(
    samples: PlacedSamples, shift: Array, part: int, shape: tuple[int, int], width: float
) -> Array:
    """Return the variance of the motion that is left in x and y, shape (2,) [px²]; 0 where none is significant.

    Args:
        samples: of the scan.
        shift: displacement of each part, shape (blocks * PARTS, 2) [px].
        part: samples in a part.
        shape, width: as for :func:`recon.imaging.sample_motion.block_equations.block_equations`.
    """
    halves = []
    for colour in (0.0, 1.0):
        half = samples._replace(value=_of_colour(samples, shift, part, colour))
        halves.append(block_equations(half, shift, part, shape, width))
    products = (halves[0].score * halves[1].score).reshape(-1, len(SHAPES), 2).sum(axis=1)
    pairs = (halves[0].information * halves[1].information).reshape(-1, len(SHAPES), 2, len(SHAPES), 2)
    weight = np.einsum("bkili->i", pairs)
    total, sd = products.sum(axis=0), np.sqrt(np.sum(products**2, axis=0))
    variance = np.divide(len(SHAPES) * total, weight, out=np.zeros(2), where=weight > 0.0)
    return np.where(total > MIN_STANDARD_SCORE * sd, variance, 0.0)


def _of_colour(samples: PlacedSamples, shift: Array, part: int, colour: float) -> NDArray[np.float32]:
    """Intensity on the squares of a colour, 0 or 1; NaN on the others."""
    value = samples.value.copy()
    knots = (np.arange(len(shift)) + 0.5) * part - 0.5
    for first in range(0, value.size, READ_CHUNK_SAMPLES):
        index = np.arange(first, min(first + READ_CHUNK_SAMPLES, value.size))
        column, row = (
            np.floor((place - np.interp(index, knots, each)) / SQUARE_PX)
            for place, each in zip(samples.places(index), shift.T, strict=True)
        )
        value[index[(column + row) % 2.0 != colour]] = np.nan
    return value
