"""Whether a picture shows more than noise: scatter between its pixels against that within them."""

from __future__ import annotations

import numpy as np

from recon.imaging.intensity_gridding import grid_intensity
from recon.imaging.picture import Picture, detector_names
from recon.imaging.picture_kinds.picture_estimate import EstimatedPicture, picture_of_sums
from recon.imaging.pixel_noise import measure_noise
from scanner.arrays import Array
from scanner.channel import READ_CHUNK_SAMPLES, Channel
from scanner.motion import Motion
from scanner.sample_ranges import SampleRanges

MAX_FLAT_EXCESS_SD = 4.0
"""Excess of the scatter between pixels over that of noise, in its standard deviations, up to which they are alike."""

MIN_MAPPED_FRACTION = 0.99
"""Fraction of the samples that lie in the pixels from which the scatter within pixels follows from that of all."""


def describe_missing_structure(
    estimate: EstimatedPicture,
    means: Picture,
    beam: Motion,
    intensity: Channel,
    cleaned: Channel,
    unlocated: SampleRanges,
) -> list[str]:
    """A line for each detector whose picture shows no more than noise.

    Args:
        estimate: the picture.
        means: picture of the means of all samples.
        beam, intensity, unlocated: as for :func:`recon.imaging.intensity_gridding.grid_intensity`.
        cleaned: the intensity without electric pulses, each of which would scatter more than the scene.
    """
    if cleaned is intensity:
        return estimate.limits or describe_unstructured(means, intensity)
    means = grid_intensity(beam, cleaned, means.grid, unlocated)
    noise = measure_noise(beam, cleaned, means.grid)
    return picture_of_sums("mean", means, None, noise).limits or describe_unstructured(means, cleaned)


def describe_unstructured(means: Picture, intensity: Channel) -> list[str]:
    """A line for each detector whose pixels scatter as samples that do not belong to places would make them.

    The ratio of the scatter between pixels to that within them is 1 for any distribution of such samples (analysis of
    variance), so that the samples need not follow the model of a detector's noise.

    Args:
        means: picture of the means of all samples.
        intensity: the samples, shape (n,) or (n, detectors).
    """
    visited = means.coverage > 0
    counts = means.coverage[visited].astype(np.float64)
    if counts.sum() - counts.size < counts.size or counts.sum() < MIN_MAPPED_FRACTION * intensity.size:
        return []
    images = means.image[visited].reshape(counts.size, -1).astype(np.float64)
    centre = np.average(images, axis=0, weights=counts)
    between = counts @ np.square(images - centre)
    within = _sum_of_squares(intensity, centre) - between
    freedom = counts.size - 1, counts.sum() - counts.size
    names = detector_names(means.detectors, centre.size)
    lines = []
    for name, first, second in zip(names, between / freedom[0], within / freedom[1], strict=True):
        spread = np.sqrt(2.0 / freedom[0] + 2.0 / freedom[1])
        if 0.0 < first < second * (1.0 + MAX_FLAT_EXCESS_SD * spread):
            lines.append(
                f"{name}: samples of one pixel differ as much as those of different pixels, so that the picture shows "
                "noise alone: check that the light was on, and that the intensity belongs to this scan"
            )
    return lines


def _sum_of_squares(intensity: Channel, centre: Array) -> Array:
    """Sum of squares of all samples about ``centre``, by detector."""
    total = np.zeros(centre.size)
    for first in range(0, intensity.size, READ_CHUNK_SAMPLES):
        values = intensity.read(first, first + READ_CHUNK_SAMPLES)
        total += np.nansum(np.square(values.reshape(len(values), -1) - centre), axis=0)
    return total
