"""Frames as OME-Zarr (OME-NGFF 0.5): means and standard deviations of every detector as channels."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.imaging.picture import Picture
from recon.io.output import pixel_size
from scanner.extras import import_extra

VERSION = "0.5"
"""Of the format: https://ngff.openmicroscopy.org/0.5."""


def write_ome_zarr(
    path: Path, frames: Iterable[tuple[Picture, NDArray[np.float32]]], count: int, frame_time: float
) -> None:
    """Write frames and their standard deviations, float32 with NaN for pixels never visited.

    The axes are t, c, y, x. The channels are the detectors, then their standard deviations. One frame at a time is in
    memory, and each is a chunk.

    Args:
        path: of the new folder.
        frames: pictures and the standard deviations of their pixels, at least one, all of one shape.
        count: number of frames.
        frame_time: time from one frame to the next [s].

    Raises:
        BadInput: zarr is not installed.
    """
    zarr = import_extra("zarr", "zarr")
    pairs = iter(frames)
    first = next(pairs)
    detectors = np.atleast_3d(first[0].image).shape[2]
    height, width = first[0].image.shape[:2]
    group = zarr.create_group(store=path, attributes={"ome": _metadata(first[0], detectors, frame_time)})
    array = group.create_array(
        "0",
        shape=(count, 2 * detectors, height, width),
        chunks=(1, 1, height, width),
        dtype=np.float32,
        fill_value=np.nan,
        dimension_names=["t", "c", "y", "x"],
    )
    for k, (picture, sd) in enumerate(chain([first], pairs)):
        for part, values in enumerate((picture.image, sd)):
            array[k, part * detectors : (part + 1) * detectors] = np.atleast_3d(values).transpose(2, 0, 1)


def _metadata(picture: Picture, detectors: int, frame_time: float) -> dict[str, Any]:
    """Attributes of the group by the specification; the specification has no unit for angles, which is therefore a
    separate attribute."""
    width, height, unit = pixel_size(picture.grid)
    length = {"unit": "micrometer"} if unit == "um" else {}
    numbered = [f"detector {k + 1}" for k in range(detectors)] if detectors > 1 else ["intensity"]
    names = list(picture.detectors) or numbered
    labels = [*names, *(f"{name}, standard deviation" for name in names)]
    axes = [
        {"name": "t", "type": "time", "unit": "second"},
        {"name": "c", "type": "channel"},
        {"name": "y", "type": "space", **length},
        {"name": "x", "type": "space", **length},
    ]
    scale = {"type": "scale", "scale": [frame_time, 1.0, height, width]}
    low, high = (float(edge) for edge in np.nanpercentile(picture.image, [0.5, 99.5]))
    window = {"start": low, "end": high, "min": low, "max": high}
    return {
        "version": VERSION,
        "multiscales": [
            {
                "name": "frames",
                "axes": axes,
                "datasets": [{"path": "0", "coordinateTransformations": [scale]}],
                "metadata": {"pixel_size_unit": unit, "angle": picture.grid.angle},
            }
        ],
        "omero": {
            "channels": [
                {"label": label, "color": "FFFFFF", "active": k < detectors, "window": window}
                for k, label in enumerate(labels)
            ]
        },
    }
