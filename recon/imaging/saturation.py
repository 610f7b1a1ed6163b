"""Pixels at the largest value of a saturated detector, of which only a lower bound is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from estimation.rail import upper_rail, upper_rail_of_counts
from recon.imaging.intensity_gridding import grid_intensity
from recon.imaging.picture import Grid
from recon.imaging.wild_samples import MAX_CHECKED_SAMPLES, usable_samples, wild_limits
from scanner.arrays import Array
from scanner.channel import Channel, LazySamples
from scanner.motion import Motion
from scanner.sample_ranges import SampleRanges

COUNT_UNITS = ("count", "counts", "photon", "photons")
"""Units of an intensity that cannot be negative and has the noise of photons."""

MAX_SATURATED_SHARE = 0.1
"""Share of a pixel's samples at the rail up to which its mean is used: it is then too small by 0.05 standard deviations
of a sample at most."""


def detector_rails(intensity: Channel) -> list[tuple[float, int] | None]:
    """Return the value at which each detector saturates and the number of checked samples there; None without."""
    values = intensity.read(0, MAX_CHECKED_SAMPLES)
    usable = usable_samples(values, wild_limits(values))
    finite = [column[use] for column, use in zip(values.reshape(len(values), -1).T, usable.T, strict=True)]
    rails = [upper_rail(each) if each.size else None for each in finite]
    if intensity.unit not in COUNT_UNITS:
        return rails
    return [rail or upper_rail_of_counts(each) for rail, each in zip(rails, finite, strict=True)]


def sd_without_saturated(
    sd: NDArray[np.float32],
    beam: Motion,
    intensity: Channel,
    grid: Grid,
    unlocated: SampleRanges,
    rails: Sequence[tuple[float, int] | None],
    first: int = 0,
    stop: int | None = None,
) -> NDArray[np.float32]:
    """Return the standard deviations of a picture with NaN where a detector is saturated.

    A pixel without samples counts as the nearest one that has some.

    Args:
        sd: of the shape of the picture.
        beam, intensity, grid, unlocated, first, stop: as for :func:`recon.imaging.intensity_gridding.grid_intensity`.
        rails: of ``detector_rails``.
    """
    if not any(rails):
        return sd
    limits = np.array([np.inf if rail is None else rail[0] for rail in rails])

    def at_rail(low: int, high: int) -> Array:
        values = intensity.read(low, high)
        return np.where(np.isfinite(values), values >= (limits if values.ndim == 2 else limits[0]), np.nan)

    samples = LazySamples(intensity.shape, np.dtype(np.float64), at_rail)
    indicator = replace(intensity, raw=samples, first=0, stop=intensity.size, gain=1.0, offset=0.0)
    share = grid_intensity(beam, indicator, grid, unlocated, first, stop)
    rows, columns = distance_transform_edt(share.coverage == 0, return_distances=False, return_indices=True)
    return np.where(share.image[rows, columns] > MAX_SATURATED_SHARE, np.float32(np.nan), sd)
