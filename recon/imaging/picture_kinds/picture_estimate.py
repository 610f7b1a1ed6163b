"""The picture of a scan in one of three kinds: mean of each pixel, kernel-weighted mean, or posterior mean."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from recon.imaging.intensity_gridding import add_scattered, empty_sums
from recon.imaging.picture import Picture, detector_names
from recon.imaging.picture_kinds.held_out import SplitSums, held_out_ranges, hold_out_neighbours
from recon.imaging.picture_kinds.kernel_picture import PictureEstimate, choose_width, kernel_image, kernel_picture
from recon.imaging.picture_kinds.recursive_frames import CarriedFrames, recursive_picture
from recon.imaging.pixel_noise import SampleNoise, pixel_sd
from scanner.arrays import Array
from scanner.channel import Channel
from scanner.errors import BadInput
from scanner.motion import Motion
from scanner.sample_ranges import SampleRanges, subtract_ranges
from scanner.wording import percent

PictureKind = Literal["mean", "kernel", "posterior"]
"""Method by which the value of a pixel is estimated."""

PICTURE_KINDS: tuple[str, ...] = get_args(PictureKind)
"""The names of the kinds."""

MIN_SPREAD_PX = 1.0
"""Smallest standard deviation of the visited pixels across any direction. Below it the samples lie on one line."""

MIN_SPREAD_SHARE = 0.6
"""The same, for a grid of few rows or columns, as a share of the standard deviation of positions over its height or
width. A line from corner to corner of two rows has 0.43 of it, all pixels of two rows have 0.87."""

MAX_FLAT_EXCESS_SD = 4.0
"""Scatter of the pixels' means beyond their noise, in its standard deviations, up to which a scene is called flat."""


FLOAT32_RELATIVE_ERROR = 1e-6
"""Relative difference up to which pixels stored as float32 are equal: eight times the resolution of the format."""

ONE_LINE = "all samples lie on one line"
"""Why samples determine no picture, for notes and errors."""


@dataclass(frozen=True)
class EstimatedPicture:
    """A picture with its uncertainty.

    Attributes:
        picture: image, and the sample count of each pixel.
        sd: standard deviation of the image, of its shape; NaN where there is no value or no measured noise.
        data_share: weight of the pixel's own samples in its value, 0 where it was not visited, of the shape of the
            image; None for a picture of means.
        resolution_px: distance between independent values [px]; None for a picture of means.
        notes: what a reader has to know of the picture, a line each.
        limits: reasons why it does not show the scene, or only a part, a line each.
        carried: what the next frame can use of this one, by detector; None where its frames are independent.
    """

    picture: Picture
    sd: NDArray[np.float32]
    data_share: NDArray[np.float32] | None = None
    resolution_px: float | None = None
    notes: list[str] = field(default_factory=list)
    limits: list[str] = field(default_factory=list)
    carried: Sequence[CarriedFrames | None] = ()

    @property
    def sd_picture(self) -> Picture:
        """The standard deviations as a picture."""
        return replace(self.picture, image=self.sd)


def estimate_picture(
    kind: str,
    means: Picture,
    noise: Sequence[SampleNoise | None],
    beam: Motion,
    intensity: Channel,
    unlocated: SampleRanges,
    first: int = 0,
    stop: int | None = None,
    before: EstimatedPicture | None = None,
) -> EstimatedPicture:
    """Return the picture of the samples ``first`` up to ``stop`` in the wanted kind.

    Args:
        kind: one of ``PICTURE_KINDS``.
        means: picture of the means of these samples.
        noise: of a sample, by detector.
        beam, intensity, unlocated, first, stop: as for :func:`recon.imaging.intensity_gridding.grid_intensity`.
        before: frame before, whose samples a posterior picture uses where they agree with those of this one; None for
            an independent picture.

    Raises:
        BadInput: no such kind, or the samples determine no picture of this kind.
    """
    held = None
    if kind != "mean":
        ranges = held_out_ranges(first, intensity.size if stop is None else stop)
        sums = empty_sums(intensity, means.grid)
        sums = add_scattered(sums, beam, intensity, means.grid, subtract_ranges(ranges, unlocated))
        held = sums.picture(intensity, means.grid)
    return picture_of_sums(kind, means, held, noise, before)


def picture_of_sums(
    kind: str,
    means: Picture,
    held: Picture | None,
    noise: Sequence[SampleNoise | None],
    before: EstimatedPicture | None = None,
    widths: Sequence[float] | None = None,
) -> EstimatedPicture:
    """Return the picture of gridded samples in the wanted kind.

    Args:
        kind, means, noise, before: as for :func:`estimate_picture`.
        held: picture of the means of the samples held out; None for ``mean``, which holds out none.
        widths: of the kernel by detector [px], see :func:`kernel_widths`; None to choose them by these samples.

    Raises:
        BadInput: as :func:`estimate_picture`.
    """
    if kind not in PICTURE_KINDS:
        raise BadInput(f"no picture is called {kind!r}", channel="picture", hint=f"give {', '.join(PICTURE_KINDS)}")
    limits = _describe_flat(means, noise)
    if kind == "mean" or held is None:
        limits += [f"intensity: {ONE_LINE}; check the motion of both axes"] if _lies_on_one_line(means) else []
        return EstimatedPicture(means, pixel_sd(means, noise), limits=limits)
    detectors = _split_sums(means, held)
    _check_determined(kind, means, detectors, noise)
    carried: Sequence[CarriedFrames | None] = (before.carried if before else ()) or [None] * len(detectors)
    chosen: Sequence[float | None] = widths or [None] * len(detectors)
    estimates, carry = zip(
        *(_estimate_detector(kind, *each) for each in zip(detectors, noise, carried, chosen, strict=True)), strict=True
    )
    image, sd, share = (
        np.stack([getattr(each, name) for each in estimates], -1).astype(np.float32).reshape(means.image.shape)
        for name in ("image", "sd", "data_share")
    )
    resolution = max(each.resolution for each in estimates)
    notes = [
        f"the picture is a {kind} estimate: detail finer than {resolution:.1f} pixels is not data but assumed to be "
        f"smooth; {np.mean(means.coverage == 0):.0%} of the pixels hold no sample, and their values follow from others"
    ]
    if not np.isfinite(image).all():
        empty = percent(float(np.mean(np.isnan(image))))
        notes.append(f"{empty} of the pixels are too far from any sample and have no value")
    return EstimatedPicture(replace(means, image=image), sd, share, resolution, notes, limits, carry)


def picture_without_sd(
    kind: str,
    means: Picture,
    held: Picture | None,
    noise: Sequence[SampleNoise | None],
    widths: Sequence[float] | None,
) -> Picture | None:
    """Return the image of :func:`picture_of_sums`, with the same arguments, in less time; None where it takes as long.

    Raises:
        BadInput: as :func:`picture_of_sums`.
    """
    if kind == "mean":
        return means
    if kind != "kernel" or held is None or widths is None:
        return None
    detectors = _split_sums(means, held)
    _check_determined(kind, means, detectors, noise)
    images = [kernel_image(*each) for each in zip(detectors, widths, strict=True)]
    return replace(means, image=np.stack(images, -1).astype(np.float32).reshape(means.image.shape))


def kernel_widths(means: Picture, held: Picture, noise: Sequence[SampleNoise | None]) -> list[float] | None:
    """Return the widths [px] of the kernels that the samples held out choose, by detector; None without noise."""
    detectors = _split_sums(means, held)
    if not held.coverage.any():
        return None
    pairs = zip(detectors, noise, strict=True)
    widths = [choose_width(samples, sample) for samples, sample in pairs if sample is not None]
    return widths if len(widths) == len(detectors) else None


def _estimate_detector(
    kind: str, samples: SplitSums, noise: SampleNoise | None, before: CarriedFrames | None, width: float | None
) -> tuple[PictureEstimate, CarriedFrames | None]:
    """Estimate of one detector, and what the next frame takes over; that of a constant detector is its level."""
    visited = samples.counts > 0
    level = _constant_level(samples.sums[visited] / samples.counts[visited], samples.counts[visited])
    if level is not None:
        variance = np.nan if noise is None else float(noise.variance(np.asarray(level)))
        sd = np.sqrt(variance / np.maximum(samples.counts, 1.0))
        return PictureEstimate(np.full(visited.shape, level), sd, visited.astype(np.float64), 0.0), None
    assert noise is not None
    if kind == "kernel":
        return kernel_picture(samples, noise, width), None
    return recursive_picture(samples, noise, before)


def _check_determined(
    kind: str, means: Picture, detectors: Sequence[SplitSums], noise: Sequence[SampleNoise | None]
) -> None:
    """Check that the samples determine a picture of a kind other than ``mean``.

    Raises:
        BadInput: they do not.
    """
    if not means.coverage.any():
        hint = "check that the intensity covers this time, and the half angles"
        raise BadInput("no sample lies in the field of view", channel="intensity", hint=hint)
    if _lies_on_one_line(means):
        hint = "check the motion of both axes or use --picture mean"
        raise BadInput(f"{ONE_LINE}, which determines no picture", channel="intensity", hint=hint)
    hint, counts = "use --picture mean", means.coverage[means.coverage > 0].astype(np.float64)
    values = means.image[means.coverage > 0].reshape(counts.size, -1).T
    levels = [_constant_level(each, counts) for each in values]
    if None not in levels:
        what = f"every sample is {levels[0]:g}: there is nothing to estimate"
        raise BadInput(what, channel="intensity", hint=hint)
    for samples, sample, level in zip(detectors, noise, levels, strict=True):
        if level is None and (sample is None or not samples.held_counts.any()):
            what = f"the scan is too short for --picture {kind}: too few pixels were visited twice to measure the noise"
            raise BadInput(what, channel="intensity", hint=f"record longer, ask for fewer pixels or {hint}")


def _constant_level(values: NDArray[Any], counts: Array) -> float | None:
    """Mean of pixels' means that differ by rounding alone, both of shape (n,); None of others."""
    mean = float(np.average(values, weights=counts))
    return mean if np.allclose(values, mean, rtol=FLOAT32_RELATIVE_ERROR, atol=0.0) else None


def _split_sums(means: Picture, held: Picture) -> list[SplitSums]:
    """Sums and counts by detector."""
    parts = []
    for picture in (means, held):
        images = picture.image.reshape(*picture.coverage.shape, -1).astype(np.float64)
        counts = picture.coverage.astype(np.float64)
        parts.append((np.moveaxis(np.nan_to_num(images) * counts[..., None], -1, 0), counts))
    (sums, counts), (held_sums, held_counts) = parts
    pairs = zip(sums, held_sums, strict=True)
    return [hold_out_neighbours(SplitSums(each, counts, other, held_counts)) for each, other in pairs]


def _lies_on_one_line(means: Picture) -> bool:
    """Whether the visited pixels spread in one direction at most; False without any."""
    visited = (means.coverage > 0).astype(np.float64)
    total = visited.sum()
    if not total:
        return False
    row, column = (np.arange(size) - 0.5 * size for size in visited.shape)
    by_row, by_column = visited.sum(axis=1), visited.sum(axis=0)
    centre = np.array([row @ by_row, column @ by_column]) / total
    cross = row @ visited @ column
    squares = np.array([[row**2 @ by_row, cross], [cross, column**2 @ by_column]]) / total
    least = min(MIN_SPREAD_PX, MIN_SPREAD_SHARE * min(visited.shape) / np.sqrt(12.0))
    return not np.linalg.eigvalsh(squares - np.outer(centre, centre))[0] > least**2


def _describe_flat(means: Picture, noise: Sequence[SampleNoise | None]) -> list[str]:
    """A line for each detector whose pixels have equal means, or means that scatter as the noise alone."""
    visited = means.coverage > 0
    if not visited.any():
        return []
    counts = means.coverage[visited].astype(np.float64)
    values = means.image[visited].reshape(counts.size, -1).T
    names = detector_names(means.detectors, len(values))
    lines = []
    for name, detector, sample in zip(names, values, noise, strict=True):
        level, mean = _constant_level(detector, counts), float(np.average(detector, weights=counts))
        if level is not None:
            lines.append(f"{name}: every sample is {level:g}: the picture shows nothing; check the detector")
            continue
        if sample is None or not (variance := float(sample.variance(np.asarray(mean)))) > 0:
            continue
        excess = float(np.mean(counts * (detector - mean) ** 2)) / variance - 1.0
        if excess < MAX_FLAT_EXCESS_SD * float(np.sqrt(2.0 / counts.size)):
            lines.append(f"{name}: no structure beyond the noise was found; the picture is flat within its uncertainty")
    return lines
