"""Output files: pictures, frames, motion and summaries. A file is complete or does not exist."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from errno import ENOSPC
from itertools import chain
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

from recon.imaging.frame_axis import FrameAxis
from recon.imaging.picture import Grid, Picture
from recon.imaging.sample_motion.rigid_motion import SampleMotion
from recon.io.tiff_size import needs_bigtiff
from scanner.channel import Channel
from scanner.errors import BadInput
from scanner.files import HAS_REPLACED, IS_REPLACING, check_no_input, check_parent, check_writable
from scanner.hdf5 import new_hdf5
from scanner.motion import Motion

CHUNK_SAMPLES = 1 << 20
"""Samples of an angle that are computed and written at a time, 8 MB."""


def check_folder(folder: Path) -> None:
    """Check that a folder can be written.

    Raises:
        BadInput: it is a file, cannot be created or is not writable.
    """
    if folder.exists() and not folder.is_dir():
        raise BadInput("is a file where a folder should be", file=folder, hint="name another with -o")
    check_parent(folder)
    check_writable(folder if folder.exists() else folder.parent)


@contextmanager
def replacing_folder(folder: Path, *inputs: object, optional: Sequence[str] = ()) -> Iterator[Path]:
    """A temporary folder to write into; its files replace those of ``folder`` when the block ends without an error.

    If the block fails, ``folder`` is unchanged. Old files are deleted before the first new file is moved, so that a
    process killed in between leaves no mixture of old and new files.

    Args:
        inputs: files that the command reads, which no new file may replace; what is no path is ignored.
        optional: names of files that the command writes with some options only. Those of an earlier run are deleted:
            beside the new files they would pass for theirs.

    Raises:
        BadInput: as :func:`check_folder`, or a new file has the place of an input.
    """
    check_folder(folder)
    temporary = folder.parent / f".{folder.name}.{uuid4().hex}.part"
    try:
        temporary.mkdir(mode=0o700)
        yield temporary
        replaced = {*optional, *(path.name for path in temporary.iterdir())}
        for name in replaced:
            check_no_input(folder / name, *(Path(each) for each in inputs if isinstance(each, str | Path)))
        IS_REPLACING.set()
        HAS_REPLACED.set()
        if not folder.exists():
            temporary.chmod(0o755)
            temporary.replace(folder)
        else:
            written = sorted(temporary.iterdir())
            for name in replaced:
                if (folder / name).is_dir():
                    shutil.rmtree(folder / name)
                else:
                    (folder / name).unlink(missing_ok=True)
            for path in written:
                path.replace(folder / path.name)
    except OSError as error:
        # The error names no file, or one in the temporary folder; name the file that the user asked for.
        error.filename = str(error.filename or folder).replace(str(temporary), str(folder))
        if error.errno is None and shutil.disk_usage(temporary).free == 0:  # as NumPy raises it after a partial write
            error.strerror = os.strerror(ENOSPC)
        raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        IS_REPLACING.clear()


def write_motion(path: Path, motion: Motion, grid: Grid) -> None:
    """Write motion.h5: a group an axis with time, phase, amplitude, frequency, phase_sd and angle.

    Amplitudes and angles are mechanical or optical, as ``grid`` states.
    """
    scales = {"amplitude": grid.angle_scale}
    with new_hdf5(path) as file:
        file.attrs.update({"estimator": motion.estimator, "angle": grid.angle})
        for name, axis in motion.axes.items():
            group = file.create_group(name)
            group.attrs.update({"reference": axis.reference, "sign": axis.sign})
            if axis.reference_frequency is not None:
                group.attrs["reference_frequency"] = axis.reference_frequency
            for key, unit in (
                ("time", "s"),
                ("phase", "rad"),
                ("amplitude", "rad"),
                ("frequency", "Hz"),
                ("phase_sd", "rad"),
            ):
                group.create_dataset(key, data=getattr(axis, key) * scales.get(key, 1.0)).attrs["unit"] = unit
            angle = group.create_dataset("angle", (axis.angle.size,), np.float32)
            for first in range(0, axis.angle.size, CHUNK_SAMPLES):
                stop = min(first + CHUNK_SAMPLES, axis.angle.size)
                angle[first:stop] = grid.angle_scale * axis.angle.read(first, stop)
            angle.attrs.update({"unit": "rad", "sample_rate": axis.angle.sample_rate, "start": axis.angle.start})


def write_sample_motion(path: Path, motion: SampleMotion, intensity: Channel, grid: Grid) -> None:
    """Write sample_motion.csv: time [s], displacement of the sample [px], its standard deviation [px], and both as an
    angle of the mirror [rad].

    Args:
        path: the file.
        motion: of the sample.
        intensity: whose clock the motion has.
        grid: the pixels; angles are mechanical or optical, as it states.
    """
    time = motion.times(intensity)
    angle = np.array(grid.pixel_angle) * grid.angle_scale
    table = np.column_stack([time, motion.shift, motion.sd, motion.shift * angle, motion.sd * angle])
    columns = [f"{quantity}_{unit}" for unit in ("px", "rad") for quantity in ("x", "y", "x_sd", "y_sd")]
    formats = ["%.9g", *["%.4f"] * 4, *["%.6g"] * 4]
    np.savetxt(path, table, formats, delimiter=",", header=",".join(["time_s", *columns]), comments="")


def pixel_size(grid: Grid) -> tuple[float, float, str]:
    """Width and height of a pixel and their unit: um on the sample if the scale is known, else rad as reported."""
    scale, unit = (grid.angle_scale, "rad") if grid.metres_per_radian is None else (1e6 * grid.metres_per_radian, "um")
    width, height = grid.pixel_angle
    return scale * width, scale * height, unit


def write_tiff(path: Path, image: NDArray[Any], grid: Grid, detectors: Sequence[str] = ()) -> None:
    """Write a picture as TIFF with unchanged values and the pixel size in ImageJ's form.

    Args:
        path: the file.
        image: shape (height, width), or (height, width, detectors); detectors become channels.
        grid: of the picture.
        detectors: names of the channels.
    """
    import tifffile

    width, height, unit = pixel_size(grid)
    planes, axes = (image, "YX") if image.ndim == 2 else (np.moveaxis(image, -1, 0), "CYX")
    if image.dtype == np.uint32:  # ImageJ reads it, but tifffile refuses to write it in ImageJ's form
        form: dict[str, Any] = {"description": f"ImageJ=1.11a\nunit={unit}\n", "metadata": None}
    else:
        labels = {"Labels": list(detectors)} if detectors and image.ndim == 3 else {}
        form = {"imagej": True, "metadata": {"axes": axes, "unit": unit, **labels}}
    tifffile.imwrite(
        path, planes, photometric="minisblack", resolution=(1 / width, 1 / height), resolutionunit="NONE", **form
    )


def write_frames(path: Path, frames: Iterable[Picture], axis: FrameAxis) -> None:
    """Write frames as OME-TIFF, float32 with NaN for pixels never visited; one frame at a time is in memory.

    OME has no angles: the pixel size is written only if the scale of the sample is known. Slices have their position,
    and their spacing if they are evenly spaced.

    Args:
        path: the file.
        frames: at least one, all of one shape.
        axis: time or position of each frame.
    """
    import tifffile

    pictures = iter(frames)
    first = next(pictures)
    detectors = first.image.shape[2:]
    metadata = _frame_metadata(axis, *detectors)
    if first.grid.metres_per_radian is not None:
        width, height, _ = pixel_size(first.grid)
        metadata |= {
            "PhysicalSizeX": width,
            "PhysicalSizeXUnit": "µm",
            "PhysicalSizeY": height,
            "PhysicalSizeYUnit": "µm",
        }
    if first.detectors and first.image.ndim == 3:
        metadata["Channel"] = {"Name": list(first.detectors)}
    planes = (plane for frame in chain([first], pictures) for plane in np.atleast_3d(frame.image).transpose(2, 0, 1))
    shape = (len(axis.values), *detectors, *first.image.shape[:2])
    axes = f"{axis.name.upper()}CYX" if detectors else f"{axis.name.upper()}YX"
    tifffile.imwrite(
        path,
        planes,
        shape=shape,
        dtype=np.float32,
        ome=True,
        photometric="minisblack",
        bigtiff=needs_bigtiff(shape, np.float32),
        metadata={"axes": axes, **metadata},
    )


def _frame_metadata(axis: FrameAxis, detectors: int = 1) -> dict[str, Any]:
    """What OME states of the frames' times or positions."""
    if axis.name == "t":
        return {} if not axis.timed else {"TimeIncrement": axis.step, "TimeIncrementUnit": "s"}
    positions = [1e6 * z for z in axis.values for _ in range(detectors)]  # of each plane, detectors varying first
    metadata: dict[str, Any] = {"Plane": {"PositionZ": positions, "PositionZUnit": ["µm"] * len(positions)}}
    if axis.even:
        metadata |= {"PhysicalSizeZ": 1e6 * axis.step, "PhysicalSizeZUnit": "µm"}
    return metadata


def write_json(path: Path, summary: Mapping[str, Any]) -> None:
    """Write a summary as JSON; numbers that are not finite become null."""
    path.write_text(json.dumps(finite(summary), indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def finite(value: Any) -> Any:
    """The value with Python's types in place of numpy's, and None for numbers that are not finite."""
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
