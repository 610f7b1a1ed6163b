"""Frames as OME-Zarr (OME-NGFF 0.5): means and standard deviations of every detector as channels."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from recon.imaging.frame_axis import FrameAxis
from recon.imaging.picture import Picture
from recon.io.output import pixel_size
from scanner.extras import import_extra

First = TypeVar("First")
Second = TypeVar("Second")

VERSION = "0.5"
"""Of the format: https://ngff.openmicroscopy.org/0.5."""


def write_ome_zarr(path: Path, frames: Iterable[tuple[Picture, NDArray[np.float32]]], axis: FrameAxis) -> None:
    """Write frames and their standard deviations, float32 with NaN for pixels never visited.

    The axes are t, c, y, x, or c, z, y, x for slices, as the specification orders them. The channels are the detectors,
    then their standard deviations. One frame at a time is in memory, and each is a chunk.

    Args:
        path: of the new folder.
        frames: pictures and the standard deviations of their pixels, at least one, all of one shape.
        axis: time or position of each frame.

    Raises:
        BadInput: zarr is not installed.
    """
    zarr = import_extra("zarr", "zarr")
    pairs = iter(frames)
    first = next(pairs)
    detectors = np.atleast_3d(first[0].image).shape[2]
    height, width = first[0].image.shape[:2]
    group = zarr.create_group(store=path)
    array = group.create_array(
        "0",
        shape=(*_ordered(axis, len(axis.values), 2 * detectors), height, width),
        chunks=(1, 1, height, width),
        dtype=np.float32,
        fill_value=np.nan,
        dimension_names=[*_ordered(axis, axis.name, "c"), "y", "x"],
    )
    limits = None
    for k, (picture, sd) in enumerate(chain([first], pairs)):
        limits = limits or _display_limits(picture)
        for part, values in enumerate((picture.image, sd)):
            channels = slice(part * detectors, (part + 1) * detectors)
            array[_ordered(axis, k, channels)] = np.atleast_3d(values).transpose(2, 0, 1)
    group.update_attributes({"ome": _metadata(first[0], detectors, axis, limits or (0.0, 1.0))})


def _display_limits(picture: Picture) -> tuple[float, float] | None:
    """Values between which a viewer shows the frames, in the intensity's unit; None for a picture without a value."""
    values = picture.image[np.isfinite(picture.image)]
    if not values.size:
        return None
    low, high = np.percentile(values, [0.5, 99.5])
    return float(low), float(high)


def _ordered(axis: FrameAxis, frame: First, channel: Second) -> tuple[First | Second, First | Second]:
    """What belongs to the frames and what belongs to the channels, in the order of the axes: time, channel, space."""
    return (frame, channel) if axis.name == "t" else (channel, frame)


def _metadata(picture: Picture, detectors: int, axis: FrameAxis, limits: tuple[float, float]) -> dict[str, Any]:
    """Attributes of the group by the specification; the specification has no unit for angles, which is therefore a
    separate attribute. ``limits``: of the display."""
    width, height, unit = pixel_size(picture.grid)
    length = {"unit": "micrometer"} if unit == "um" else {}
    numbered = [f"detector {k + 1}" for k in range(detectors)] if detectors > 1 else ["intensity"]
    names = list(picture.detectors) or numbered
    labels = [*names, *(f"{name}, standard deviation" for name in names)]
    time = axis.name == "t"
    succession = {"type": "time"} if time else {"type": "space", "unit": "micrometer"}
    succession |= {"unit": "second"} if axis.timed else {}
    axes = [
        *_ordered(axis, {"name": axis.name, **succession}, {"name": "c", "type": "channel"}),
        {"name": "y", "type": "space", **length},
        {"name": "x", "type": "space", **length},
    ]
    step = 1.0 if np.isnan(axis.step) else axis.step if time else 1e6 * axis.step
    transformations = [{"type": "scale", "scale": [*_ordered(axis, step, 1.0), height, width]}]
    metadata: dict[str, Any] = {"pixel_size_unit": unit, "angle": picture.grid.angle}
    if not time:
        transformations.append({"type": "translation", "translation": [0.0, 1e6 * axis.values[0], 0.0, 0.0]})
        metadata["z_um"] = [1e6 * z for z in axis.values]  # the scale is the mean spacing
    low, high = limits
    window = {"start": low, "end": high, "min": low, "max": high}
    return {
        "version": VERSION,
        "multiscales": [
            {
                "name": "frames",
                "axes": axes,
                "datasets": [{"path": "0", "coordinateTransformations": transformations}],
                "metadata": metadata,
            }
        ],
        "omero": {
            "channels": [
                {"label": label, "color": "FFFFFF", "active": k < detectors, "window": window}
                for k, label in enumerate(labels)
            ]
        },
    }
