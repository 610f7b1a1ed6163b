"""The picture: its pixels over the field of view, the mean intensity and sample count of each, and filling of holes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from scanner.arguments import check_numbers, check_whole_numbers
from scanner.errors import BadInput
from scanner.stages import Scan

if TYPE_CHECKING:
    import xarray

MAX_PIXELS = 1 << 29
"""Pixels of a picture have to be fewer than this: gridding counts them in an int32 and needs a value beyond them."""


def detector_names(stated: Sequence[str], count: int) -> list[str]:
    """Name of each of ``count`` detectors in messages; ``stated`` may be empty."""
    several = stated or [f"detector {number}" for number in range(count)]
    return [f"intensity, {name}" for name in several] if count > 1 else ["intensity"]


@dataclass(frozen=True)
class Grid:
    """The pixels over the field of view. Column 0 is θ_x = -half_angle_x, row 0 is θ_y = -half_angle_y.

    Attributes:
        width, height: pixels.
        half_angle_x, half_angle_y: mechanical angle at the edge of the field [rad].
        metres_per_radian: displacement of the beam on the sample by mechanical angle [m/rad]; None if unknown.
        angle: kind of the angles that files and reports state, ``"mechanical"`` or ``"optical"``.

    Raises:
        BadInput: a size, an angle or the scale is no number, or not positive and finite, the kind of the angles is
            another one, or there are ``MAX_PIXELS`` pixels or more.
    """

    width: int
    height: int
    half_angle_x: float
    half_angle_y: float
    metres_per_radian: float | None = None
    angle: str = "mechanical"

    def __post_init__(self) -> None:
        check_whole_numbers(width=self.width, height=self.height)
        check_numbers(half_angle_x=self.half_angle_x, half_angle_y=self.half_angle_y)
        if self.width < 1 or self.height < 1:
            raise BadInput(f"a picture of {self.width}x{self.height} pixels", hint="give at least 1x1")
        if self.width * self.height >= MAX_PIXELS:
            raise BadInput(f"a picture of {self.width}x{self.height} pixels", hint=f"give fewer than {MAX_PIXELS}")
        if self.angle not in Scan.ANGLES:
            raise BadInput(f"is {self.angle!r}", channel="angle", hint="give 'mechanical' or 'optical'")
        if self.metres_per_radian is not None:
            check_numbers(metres_per_radian=self.metres_per_radian)
            if not 0.0 < self.metres_per_radian < math.inf:
                hint = "give a positive, finite number, or None"
                raise BadInput(f"is {self.metres_per_radian}", channel="metres_per_radian", hint=hint)
        if not all(math.isfinite(half) and half > 0 for half in (self.half_angle_x, self.half_angle_y)):
            raise BadInput(
                f"half angles of {self.half_angle_x} and {self.half_angle_y} rad", hint="give positive, finite angles"
            )

    @property
    def angle_scale(self) -> float:
        """Reported angle by mechanical angle: 1, or 2 for optical angles."""
        return 2.0 if self.angle == "optical" else 1.0

    @property
    def reported_half_angles(self) -> tuple[float, float]:
        """Half the field in x and y as reports state it [rad]."""
        return self.half_angle_x * self.angle_scale, self.half_angle_y * self.angle_scale

    @property
    def pixel_angle(self) -> tuple[float, float]:
        """Width and height of a pixel, mechanical angle [rad]."""
        return 2 * self.half_angle_x / self.width, 2 * self.half_angle_y / self.height


def grid_of_scan(width: int, height: int, scan: Scan) -> Grid:
    """Return the pixels over a device's field of view; the grid reports the kind of angle that ``scan`` states."""
    scale = None if scan.metres_per_radian is None else scan.metres_per_radian * scan.angle_scale
    return Grid(width, height, *scan.mechanical_half_angles, scale, scan.angle_kind)


@dataclass(frozen=True)
class Picture:
    """Mean intensity and sample count of each pixel.

    Attributes:
        image: mean intensity, shape (height, width) or (height, width, detectors), float32; NaN where never visited.
        coverage: samples in each pixel, shape (height, width), uint32.
        grid: the pixels over the field of view.
        outside: number of samples that fell outside the field of view.
        detectors: names of the last axis of ``image``, where the recording states them.
    """

    image: NDArray[np.float32]
    coverage: NDArray[np.uint32]
    grid: Grid
    outside: int = 0
    detectors: tuple[str, ...] = ()

    def to_xarray(self) -> xarray.Dataset:
        """Return ``image`` and ``coverage`` as an xarray dataset over the angles of the pixels' middles.

        Raises:
            BadInput: xarray is not installed.
        """
        from scanner.extras import import_extra

        grid, scale = self.grid, self.grid.angle_scale
        coordinates: dict[str, Any] = {}
        for axis, count, half in (("y", grid.height, grid.half_angle_y), ("x", grid.width, grid.half_angle_x)):
            middle = scale * half * ((2.0 * np.arange(count) + 1.0) / count - 1.0)
            coordinates[axis] = (axis, middle, {"units": "rad", "long_name": f"{grid.angle} angle of {axis}"})
        dimensions = ("y", "x") if self.image.ndim == 2 else ("y", "x", "detector")
        if self.image.ndim == 3 and self.detectors:
            coordinates["detector"] = ("detector", list(self.detectors))
        variables = {
            "image": (dimensions, self.image, {"long_name": "mean intensity"}),
            "coverage": (("y", "x"), self.coverage, {"units": "1", "long_name": "samples of a pixel"}),
        }
        dataset: xarray.Dataset = import_extra("xarray", "xarray").Dataset(variables, coordinates)
        if grid.metres_per_radian is not None:
            dataset.attrs["metres_per_radian"] = grid.metres_per_radian / scale  # of the angles that are stated
        return dataset

    def __repr__(self) -> str:
        grid, visited = self.grid, np.count_nonzero(self.coverage) / self.coverage.size
        half_x, half_y = grid.reported_half_angles
        return (
            f"Picture of {grid.width} x {grid.height} pixels, {visited:.1%} of them visited, "
            f"{int(self.coverage.sum())} samples, half angles {half_x:.4g} x {half_y:.4g} rad {grid.angle}"
        )


def fill_factor(coverage: NDArray[Any]) -> float:
    """Return the fraction of the pixels with at least one sample."""
    return float(np.count_nonzero(coverage)) / coverage.size


def fill_holes(picture: Picture, radius: int) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Fill the small holes of a picture from their visited neighbours, by normalised convolution.

    The value of a hole is the mean of the visited pixels at most ``radius`` columns and rows away, weighted by a
    Gaussian of standard deviation radius/2 and by their sample counts. Visited pixels are not changed. Holes without a
    visited pixel in reach remain NaN.

    Args:
        picture: with NaN where never visited.
        radius: reach [px], at least 1.

    Returns:
        The filled image, shape of ``picture.image``, and the mask of the filled pixels, shape (height, width).

    Raises:
        BadInput: a radius below 1.

    Source:
        Knutsson & Westin 1993, "Normalized and differential convolution", with the sample count as certainty.
    """
    from scipy.ndimage import gaussian_filter

    if radius < 1:
        raise BadInput(f"a fill radius of {radius} pixels", hint="give at least 1")
    certainty = picture.coverage.astype(float)
    values = picture.image.reshape(*certainty.shape, -1)
    visited = certainty > 0

    def spread(field: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(gaussian_filter(field, radius / 2, radius=radius, axes=(0, 1), mode="constant"))

    weight = spread(certainty)
    filled = ~visited & (weight > 0)
    total = spread(np.where(visited[..., None], values, 0.0) * certainty[..., None])
    image = values.copy()
    image[filled] = total[filled] / weight[filled][:, None]
    return image.reshape(picture.image.shape), filled
