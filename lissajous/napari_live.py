"""Live view in napari: the picture of a running ``lissajous reconstruct --follow``, replaced with each new frame."""

from __future__ import annotations

import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

POLL_INTERVAL_S = 0.1
"""Time between two looks at the folder [s]: new pictures appear without a visible delay, at a negligible load."""

FOLLOWED_KEY = "lissajous_folder"
"""Key of a layer's metadata that holds the folder which the layer shows."""

Layer = tuple[Any, dict[str, Any], str]
"""Data, arguments and kind of a layer, as napari takes them."""


def read_folder(path: Path) -> list[Layer]:
    """Return the picture of an output folder as a layer for each detector, refreshed while the folder is followed.

    Args:
        path: output folder of ``lissajous reconstruct``, also of a ``--follow`` that is still running.

    Raises:
        ValueError: ``image.tif`` is not a picture of this program.
    """
    image, place = _read_picture(path / "image.tif")
    layers: list[Layer] = []
    for number, plane in enumerate(_planes(image)):
        name = path.name if image.ndim == 2 else f"{path.name}, detector {number + 1}"
        arguments = {"name": name, "contrast_limits": display_limits(plane), **place}
        layers.append((plane, {**arguments, "metadata": {FOLLOWED_KEY: (str(path), number)}}, "image"))
    if is_followed(path):
        _start_refreshing(path)
    return layers


def display_limits(plane: NDArray[np.float32]) -> tuple[float, float]:
    """Return the values shown black and white, the second always the larger, as napari needs it.

    Args:
        plane: picture of one detector, shape (height, width); NaN where never visited.
    """
    low, high = (float(edge) for edge in np.nanpercentile(plane, [0.5, 99.5]))
    return low, high if high > low else float(np.nextafter(np.float32(low), np.float32(np.inf)))


def is_followed(folder: Path) -> bool:
    """Return whether the folder has a picture and no summary, as while ``--follow`` runs."""
    return (folder / "image.tif").exists() and not (folder / "summary.json").exists()


def watch_pictures(folder: Path) -> Iterator[NDArray[np.float32] | None]:
    """Yield each new picture of a followed folder, None where there is no new one, and end with the final picture.

    It also ends when the folder is removed. Between two looks it sleeps for ``POLL_INTERVAL_S``.

    Args:
        folder: output folder.
    """
    path = folder / "image.tif"
    shown: int | None = None
    while folder.is_dir():
        final = not is_followed(folder)
        try:
            stamp = path.stat().st_mtime_ns
            image = None if stamp == shown else _read_picture(path)[0]
            shown = stamp
        except (OSError, ValueError):  # it is being replaced
            image = None
        if image is not None or not final:
            yield image
        if final and path.exists() and path.stat().st_mtime_ns == shown:
            return
        time.sleep(POLL_INTERVAL_S)


def show_picture(viewer: Any, folder: Path, image: NDArray[np.float32] | None) -> None:
    """Show a picture in the layers of its folder; their contrast and everything else that the user set remain.

    Args:
        viewer: napari's.
        folder: that the layers show.
        image: None changes nothing.
    """
    if image is None:
        return
    planes = _planes(image)
    for layer in viewer.layers:
        shown, number = layer.metadata.get(FOLLOWED_KEY, (None, 0))
        if shown == str(folder) and number < len(planes):
            layer.data = planes[number]


def _start_refreshing(folder: Path) -> None:
    """Refresh the layers of a folder in the open viewer; without a viewer the picture remains as it was read."""
    try:
        from napari import current_viewer
        from napari.qt.threading import thread_worker
    except ImportError:  # read by another program, or napari without a window
        return
    viewer = current_viewer()
    if viewer is not None:
        thread_worker(watch_pictures, connect={"yielded": partial(show_picture, viewer, folder)})(folder)


def _planes(image: NDArray[np.float32]) -> list[NDArray[np.float32]]:
    return [image] if image.ndim == 2 else list(image)


def _read_picture(path: Path) -> tuple[NDArray[np.float32], dict[str, Any]]:
    """The picture, shape (height, width) or (detectors, height, width), and its place in mrad or µm.

    Raises:
        ValueError: the file states no pixel size.
    """
    import tifffile

    with tifffile.TiffFile(path) as file:
        image, tags, stated = file.asarray(), file.pages.first.tags, file.imagej_metadata or {}
        try:
            height, width = (tags[name].value[1] / tags[name].value[0] for name in ("YResolution", "XResolution"))
        except (KeyError, ZeroDivisionError):
            raise ValueError(f"{path}: states no pixel size") from None
    factor, unit = (1e3, "mrad") if stated.get("unit") == "rad" else (1.0, "um")
    scale = factor * np.array([height, width])
    corner = -0.5 * scale * (np.array(image.shape[-2:]) - 1)
    return image, {"scale": tuple(scale), "translate": tuple(corner), "units": (unit, unit)}
