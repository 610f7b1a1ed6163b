"""Reader for napari: recordings become picture, coverage and path of the beam; output folders become their picture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lissajous.napari_live import Layer, display_limits, read_folder

if TYPE_CHECKING:
    from recon.steps.reconstruction import Reconstruction

MAX_PATH_POINTS = 20_000
"""Points of the beam's path that are shown: more cover the picture."""


def get_reader(path: str | Sequence[str]) -> Callable[[str | Sequence[str]], list[Layer]] | None:
    """Return the function that reads a recording or an output folder, None for others and for several at once.

    Args:
        path: of the file or folder.
    """
    import h5py

    from scanner.recording_file import FORMAT

    if not isinstance(path, str):
        return None
    if Path(path).is_dir():
        return read_output if _is_output(Path(path)) else None
    try:
        with h5py.File(path) as file:
            stated = file.attrs.get("format")
    except OSError:
        return None
    return read_recording if stated in (FORMAT, FORMAT.encode()) else None


def read_output(path: str | Sequence[str]) -> list[Layer]:
    """Return the picture of an output folder; while ``--follow`` runs it is replaced with each new frame.

    Args:
        path: of the folder.
    """
    return read_folder(Path(str(path)))


def _is_output(folder: Path) -> bool:
    """Whether a folder was written by ``reconstruct``: no other folder is taken from napari's own readers."""
    return all((folder / name).is_file() for name in ("image.tif", "image_sd.tif", "image.png"))


def read_recording(path: str | Sequence[str]) -> list[Layer]:
    """Reconstruct a recording and return the layers picture, coverage and beam path.

    Args:
        path: of the file.

    Raises:
        BadInput: the recording cannot be used.
    """
    from lissajous.functions import reconstruct

    result = reconstruct(Path(str(path)))
    picture, grid = result.picture, result.picture.grid
    width, height = (1e3 * grid.angle_scale * size for size in grid.pixel_angle)
    corner = (-0.5 * height * (grid.height - 1), -0.5 * width * (grid.width - 1))
    place = {"scale": (height, width), "translate": corner}
    units = {"units": ("mrad", "mrad")}
    metadata = {"metadata": {"notes": [*result.limits, *result.notes], "angle": grid.angle}}
    layers: list[Layer] = []
    planes = [picture.image] if picture.image.ndim == 2 else list(np.moveaxis(picture.image, -1, 0))
    names = picture.detectors or tuple(f"detector {k + 1}" for k in range(len(planes)))
    for plane, name in zip(planes, (result.name,) if len(planes) == 1 else names, strict=True):
        shown = {"name": name, "contrast_limits": display_limits(plane)}
        layers.append((plane, {**shown, **place, **metadata}, "image"))
    hidden = {"visible": False}
    layers.append((picture.coverage, {"name": "coverage", "colormap": "viridis", **hidden, **place}, "image"))
    path_of_beam = {"name": "beam", "shape_type": "path", "edge_width": width / 4, **hidden}
    layers.append((_beam_path(result), path_of_beam, "shapes"))
    return [(data, {**arguments, **units}, kind) for data, arguments, kind in layers]


def _beam_path(result: Reconstruction) -> list[Any]:
    """The beginning of the beam's path, rows of y and x [mrad], as one path."""
    scale = 1e3 * result.picture.grid.angle_scale
    angles = [scale * result.beam.axes[axis].angle.read(0, MAX_PATH_POINTS) for axis in "yx"]
    return [np.stack(angles, axis=1)]
