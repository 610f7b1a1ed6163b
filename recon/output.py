"""What a reconstruction leaves on disk: pictures, motion, summary, each complete or not there at all."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from scanner.errors import BadInput
from scanner.motion import Motion

CHUNK = 1 << 20  # samples written at a time


def check_folder(folder: Path) -> None:
    """Refuse a folder for output that is a file, or that should stand in a folder that does not exist (BadInput)."""
    if folder.exists() and not folder.is_dir():
        raise BadInput("is a file where a folder should be", file=folder, hint="name another with -o")
    if not folder.parent.is_dir():
        raise BadInput("the folder to write into does not exist", file=folder.parent, hint="create it")


@contextmanager
def replacing_folder(folder: Path) -> Iterator[Path]:
    """A folder to write into, beside ``folder``; its files take their places in ``folder`` when the block ends well.

    When the block fails, ``folder`` is as it was: not there, or with its older files.

    Raises:
        BadInput: ``folder`` is a file, or the folder that it should stand in does not exist.
    """
    check_folder(folder)
    beside = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", suffix=".part", dir=folder.parent))
    try:
        yield beside
        if not folder.exists():
            beside.chmod(0o755)
            beside.replace(folder)
        else:
            for path in sorted(beside.iterdir()):
                path.replace(folder / path.name)
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def write_motion(path: Path, motion: Motion) -> None:
    """motion.h5: a group an axis with time, phase, amplitude, frequency, phase_sd and angle."""
    with h5py.File(path, "w") as file:
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


def write_tiff(path: Path, image: NDArray[Any]) -> None:
    """A picture as TIFF, its values as they are; a last axis of detectors becomes planes."""
    import tifffile

    planes = image if image.ndim == 2 else np.moveaxis(image, -1, 0)
    tifffile.imwrite(path, planes, photometric="minisblack")


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
