"""What a reconstruction leaves on disk: pictures, motion, summary, each complete or not there at all."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.mapping import Grid, Picture
from scanner.errors import BadInput
from scanner.files import check_writable
from scanner.hdf5 import new_hdf5
from scanner.motion import Motion

CHUNK = 1 << 20  # samples written at a time


def check_folder(folder: Path) -> None:
    """Refuse a folder for output that is a file, or that cannot be made or written into (BadInput)."""
    if folder.exists() and not folder.is_dir():
        raise BadInput("is a file where a folder should be", file=folder, hint="name another with -o")
    if not folder.parent.is_dir():
        raise BadInput("the folder to write into does not exist", file=folder.parent, hint="create it")
    check_writable(folder if folder.exists() else folder.parent)


@contextmanager
def replacing_folder(folder: Path) -> Iterator[Path]:
    """A folder to write into, beside ``folder``; its files take their places in ``folder`` when the block ends well.

    When the block fails, ``folder`` is as it was: not there, or with its older files. These are gone before the first
    of the new ones comes: whoever ends the process in between leaves no mixture that looks whole.

    Raises:
        BadInput: as :func:`check_folder`.
    """
    check_folder(folder)
    beside = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", suffix=".part", dir=folder.parent))
    try:
        yield beside
        if not folder.exists():
            beside.chmod(0o755)
            beside.replace(folder)
        else:
            made = sorted(beside.iterdir())
            for path in made:
                (folder / path.name).unlink(missing_ok=True)
            for path in made:
                path.replace(folder / path.name)
    except OSError as error:
        # Where writing failed nothing names the file, or else a hidden one, which tells nobody anything.
        error.filename = str(error.filename or folder).replace(str(beside), str(folder))
        raise
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def write_motion(path: Path, motion: Motion) -> None:
    """motion.h5: a group an axis with time, phase, amplitude, frequency, phase_sd and angle."""
    with new_hdf5(path) as file:
        file.attrs["estimator"] = motion.estimator
        for name, axis in motion.axes.items():
            group = file.create_group(name)
            group.attrs.update({"reference": axis.reference, "sign": axis.sign})
            for key, unit in (
                ("time", "s"),
                ("phase", "rad"),
                ("amplitude", "rad"),
                ("frequency", "Hz"),
                ("phase_sd", "rad"),
            ):
                group.create_dataset(key, data=getattr(axis, key)).attrs["unit"] = unit
            angle = group.create_dataset("angle", (axis.angle.size,), np.float32)
            for first in range(0, axis.angle.size, CHUNK):
                stop = min(first + CHUNK, axis.angle.size)
                angle[first:stop] = axis.angle.read(first, stop)
            angle.attrs.update({"unit": "rad", "sample_rate": axis.angle.sample_rate, "start": axis.angle.start})


def pixel_size(grid: Grid) -> tuple[float, float, str]:
    """Width and height of a pixel and their unit: um on the sample where the scale is known, else rad of the mirror."""
    scale, unit = (1.0, "rad") if grid.metres_per_radian is None else (1e6 * grid.metres_per_radian, "um")
    width, height = grid.pixel_angle
    return scale * width, scale * height, unit


def write_tiff(path: Path, image: NDArray[Any], grid: Grid) -> None:
    """A picture as TIFF, its values as they are, to scale (see :func:`pixel_size`) for ImageJ and what reads its files.

    Args:
        image: shape (height, width), or (height, width, detectors), whose detectors become channels.
    """
    import tifffile

    width, height, unit = pixel_size(grid)
    planes, axes = (image, "YX") if image.ndim == 2 else (np.moveaxis(image, -1, 0), "CYX")
    if image.dtype == np.uint32:  # which tifffile does not take for ImageJ's, though ImageJ reads it
        form: dict[str, Any] = {"description": f"ImageJ=1.11a\nunit={unit}\n", "metadata": None}
    else:
        form = {"imagej": True, "metadata": {"axes": axes, "unit": unit}}
    tifffile.imwrite(
        path, planes, photometric="minisblack", resolution=(1 / width, 1 / height), resolutionunit="NONE", **form
    )


def write_frames(path: Path, frames: Iterable[Picture], count: int, frame_time: float) -> None:
    """A scan's frames as OME-TIFF, float32 with NaN where never visited; one frame at a time is in memory.

    OME knows lengths but no angles: a pixel has a size where the scale of the sample is known, else none.

    Args:
        frames: as many as ``count``, at least one, of one shape. frame_time: from one to the next [s].
    """
    import tifffile

    pictures = iter(frames)
    first = next(pictures)
    told: dict[str, Any] = {"TimeIncrement": frame_time, "TimeIncrementUnit": "s"}
    if first.grid.metres_per_radian is not None:
        width, height, _ = pixel_size(first.grid)
        told |= {"PhysicalSizeX": width, "PhysicalSizeXUnit": "µm", "PhysicalSizeY": height, "PhysicalSizeYUnit": "µm"}
    planes = (plane for each in chain([first], pictures) for plane in np.atleast_3d(each.image).transpose(2, 0, 1))
    shape, axes = (count, *first.image.shape[2:], *first.image.shape[:2]), "TCYX" if first.image.ndim == 3 else "TYX"
    tifffile.imwrite(
        path, planes, shape=shape, dtype=np.float32, ome=True, photometric="minisblack", metadata={"axes": axes, **told}
    )


def write_json(path: Path, summary: Mapping[str, Any]) -> None:
    """Summary as JSON; a number that is not finite becomes null, which every reader of JSON takes."""
    path.write_text(json.dumps(finite(summary), indent=1) + "\n", encoding="utf-8")


def finite(value: Any) -> Any:
    """The value with numpy's types turned into Python's and numbers that are not finite into None."""
    if isinstance(value, Mapping):
        return {str(key): finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    if isinstance(value, np.ndarray):
        return finite(value.tolist())
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
