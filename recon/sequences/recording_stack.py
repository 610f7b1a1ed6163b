"""Pictures of several recordings as one stack: planes of a specimen, or repeats of one scan."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.imaging.frame_axis import FrameAxis, position_axis
from recon.imaging.picture import Grid, Picture
from recon.io.ome_zarr import write_ome_zarr
from recon.io.output import write_frames
from recon.report.movie import write_movie
from scanner.device import AXES
from scanner.errors import BadInput

MAX_Z_RANGE_STEPS = 0.5
"""Movement of z within a recording, in distances to the nearest plane, up to which the recording is one plane."""


@dataclass(frozen=True)
class Plane:
    """A completed reconstruction that becomes a plane of a stack.

    Attributes:
        name: of the recording.
        folder: with its pictures.
        summary: content of its summary.json.
    """

    name: str
    folder: Path
    summary: Mapping[str, Any]

    @property
    def grid(self) -> Grid:
        return Grid(**self.summary["grid"])

    def read(self, kind: str, mirrored: Sequence[str] = ()) -> Picture:
        """Return ``image`` or ``image_sd``, mirrored in the stated axes."""
        import tifffile

        values = tifffile.imread(self.folder / f"{kind}.tif")
        image = values if values.ndim == 2 else np.moveaxis(values, 0, -1)
        coverage = tifffile.imread(self.folder / "coverage.tif")
        flip = (slice(None, None, -1 if "y" in mirrored else 1), slice(None, None, -1 if "x" in mirrored else 1))
        return Picture(image[flip], coverage[flip], self.grid, 0, tuple(self.summary["detectors"]))


def read_planes(folders: Mapping[Path, Path]) -> list[Plane]:
    """Return the planes of completed reconstructions, by recording."""
    return [
        Plane(path.name, folder, json.loads((folder / "summary.json").read_text(encoding="utf-8")))
        for path, folder in folders.items()
    ]


def write_recording_stack(
    output: Path, planes: Sequence[Plane], spacing: float | None = None, zarr: bool = False, movie: str | None = None
) -> dict[str, Any]:
    """Write the pictures of several recordings as one stack, and return its summary.

    With a spacing the recordings are planes in the order given. Else they are planes in the order of their
    ``position_z``; and where none has a position, repeats of one scan in the order given.

    Args:
        output: folder for ``stack.ome.tif``, ``stack_sd.ome.tif`` and what is asked for.
        planes: the recordings.
        spacing: distance of one plane from the next [m].
        zarr: write ``stack.ome.zarr`` too.
        movie: write a movie too, ``"mp4"`` or ``"gif"``.

    Raises:
        BadInput: pictures of different fields, sizes, units or detectors, some without a position, or two at one
            position.
    """
    _check_alike(planes)
    planes, axis = _order(planes, spacing)
    mirrored = _mirrored_planes(planes)

    def pictures(kind: str) -> Iterator[Picture]:
        for plane, axes in zip(planes, mirrored, strict=True):
            yield plane.read(kind, axes)

    write_frames(output / "stack.ome.tif", pictures("image"), axis)
    write_frames(output / "stack_sd.ome.tif", pictures("image_sd"), axis)
    if zarr:
        deviations = (picture.image for picture in pictures("image_sd"))
        write_ome_zarr(output / "stack.ome.zarr", zip(pictures("image"), deviations, strict=True), axis)
    if movie:
        limits = np.array([np.nanpercentile(picture.image, [0.5, 99.5]) for picture in pictures("image")])
        write_movie(output / f"stack.{movie}", pictures("image"), axis, (limits[:, 0].min(), limits[:, 1].max()))
    return {
        "recordings": [plane.name for plane in planes],
        "z_m": list(axis.values) if axis.name == "z" else None,
        "step_m": axis.step if axis.name == "z" else None,
        "even": axis.even,
        "mirrored": {plane.name: list(axes) for plane, axes in zip(planes, mirrored, strict=True) if axes},
        "notes": [*_describe_movement(planes, axis), *_describe_mirrored(planes, mirrored)],
    }


def _check_alike(planes: Sequence[Plane]) -> None:
    first = planes[0]
    for other in planes[1:]:
        if other.summary["grid"] != first.summary["grid"]:
            own, known = (1e3 * np.array(plane.grid.reported_half_angles) for plane in (other, first))
            what = f"has half angles of {own[0]:.5g} x {own[1]:.5g} mrad, and {first.name} of {known[0]:.5g} x "
            what += f"{known[1]:.5g} mrad: they are no stack"
            hint = "state one field, [scan], in the device file, and give it with --device"
            raise BadInput(what, file=other.name, channel="--stack", hint=hint)
        units = [plane.summary.get("intensity_unit") for plane in (other, first)]
        if units[0] != units[1]:
            what = f"has an intensity in {units[0]!r}, and {first.name} in {units[1]!r}: they are no stack"
            hint = "convert one of them with the unit of the other"
            raise BadInput(what, file=other.name, channel="--stack", hint=hint)
        if other.summary["detectors"] != first.summary["detectors"]:
            what = f"has other detectors than {first.name}: they are no stack"
            raise BadInput(what, file=other.name, channel="--stack", hint="leave it out")


def _order(planes: Sequence[Plane], spacing: float | None) -> tuple[Sequence[Plane], FrameAxis]:
    """The planes in their order, and their positions or numbers."""
    if spacing is not None:
        return planes, position_axis([spacing * k for k in range(len(planes))])
    positions = [plane.summary["position_z"] for plane in planes]
    if not any(positions):
        return planes, FrameAxis("t", list(range(len(planes))), float("nan"))
    if not all(positions):
        missing = planes[[bool(each) for each in positions].index(False)]
        hint = "record it with every plane, or give their spacing in metres, --stack 1e-6"
        raise BadInput("is not in the recording", file=missing.name, channel="position_z", hint=hint)
    ordered = sorted(planes, key=lambda plane: plane.summary["position_z"]["mean_m"])
    z = [plane.summary["position_z"]["mean_m"] for plane in ordered]
    for (a, low), (b, high) in pairwise(zip(ordered, z, strict=True)):
        if low == high:
            hint = "leave one out, or give the spacing of the planes in metres, --stack 1e-6"
            raise BadInput(f"is {low:.6g} m, as that of {a.name}", file=b.name, channel="position_z", hint=hint)
    return ordered, position_axis(z)


def _mirrored_planes(planes: Sequence[Plane]) -> list[tuple[str, ...]]:
    """Axes in which each plane has to be mirrored to agree best with its neighbour, where its sign is ambiguous.

    The comparison begins at the first of the planes with the fewest ambiguous signs, and continues to both ends.
    """
    origin = min(range(len(planes)), key=lambda k: len(_ambiguous_axes(planes[k])))
    mirrored: list[tuple[str, ...]] = [()] * len(planes)
    for order in (range(origin, len(planes)), range(origin, -1, -1)):
        for known, k in pairwise(order):
            neighbour, ambiguous = planes[known].read("image", mirrored[known]), _ambiguous_axes(planes[k])
            options = [tuple(axis for axis, turn in zip(ambiguous, turns, strict=True) if turn)
                       for turns in product((False, True), repeat=len(ambiguous))]  # fmt: skip
            agreement = [_correlation(neighbour.image, planes[k].read("image", axes).image) for axes in options]
            mirrored[k] = options[int(np.argmax(agreement))]
    return mirrored


def _ambiguous_axes(plane: Plane) -> list[str]:
    """Axes of which the recording of a plane does not determine the sign."""
    return [axis for axis in AXES if plane.summary["sign"][axis] == "ambiguous"]


def _correlation(first: NDArray[np.float32], second: NDArray[np.float32]) -> float:
    """Correlation coefficient of two pictures over the pixels that both have; -1 where there is none."""
    both = np.isfinite(first) & np.isfinite(second)
    a, b = first[both].astype(np.float64), second[both].astype(np.float64)
    if a.size < 2 or not np.ptp(a) > 0.0 or not np.ptp(b) > 0.0:
        return -1.0
    return float(np.corrcoef(a, b)[0, 1])


def _describe_movement(planes: Sequence[Plane], axis: FrameAxis) -> Iterator[str]:
    """A note on the recordings within which z moves towards the next plane."""
    if axis.name != "z" or len(planes) < 2:
        return
    nearest = float(np.diff(axis.values).min())
    for plane in planes:
        z = plane.summary["position_z"]
        if z is not None and z["range_m"] > MAX_Z_RANGE_STEPS * abs(nearest):
            yield (
                f"{plane.name}: position_z moves by {1e6 * z['range_m']:.3g} µm, and planes are "
                f"{1e6 * abs(nearest):.3g} µm apart: --z-step cuts a recording into slices"
            )


def _describe_mirrored(planes: Sequence[Plane], mirrored: Sequence[Sequence[str]]) -> Iterator[str]:
    """A note on signs that the recordings do not determine."""
    ambiguous = [axis for axis in AXES if any(axis in _ambiguous_axes(plane) for plane in planes)]
    if ambiguous:
        turned = [f"{plane.name} in {' and '.join(axes)}" for plane, axes in zip(planes, mirrored, strict=True) if axes]
        unknown = [axis for axis in AXES if all(axis in _ambiguous_axes(plane) for plane in planes)]
        yield (
            f"the sign of {' and '.join(ambiguous)} is ambiguous: planes are mirrored where that agrees better with "
            f"the plane beside ({', '.join(turned) or 'none'})"
            + (f", and the whole stack may be mirrored in {' and '.join(unknown)}" if unknown else "")
        )
