"""Frames of a scan: pictures of successive parts of the time, with the motion of the whole scan."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

from recon.imaging.intensity_gridding import grid_intensity
from recon.imaging.picture import Picture
from recon.imaging.pixel_noise import pixel_sd
from recon.io.output import write_frames
from recon.pipeline import Options, Reconstruction
from recon.quality.defects import unrecoverable_intervals
from recon.sample_ranges import to_sample_ranges
from scanner.errors import BadInput


def write_scan_frames(path: Path, result: Reconstruction, options: Options) -> None:
    """Write ``options.frames`` frames, or one each ``options.frame_time``, and their standard deviations as OME-TIFF.

    With ``frame_time`` the last frame may be shorter than the others.

    Args:
        path: of the new file, ``frames.ome.tif``; the standard deviations are written to ``frames_sd.ome.tif`` in the
            same folder.
        result: the reconstruction of the whole scan.
        options: ``frames`` and ``frame_time``.

    Raises:
        BadInput: a frame would hold less than one sample.
    """
    frame_time = options.frame_time or result.duration / (options.frames or 1)
    intensity = result.intensity
    length = frame_time * intensity.sample_rate
    if length < 1:
        what = f"has {intensity.sample_rate:.4g} samples a second, and frames of {frame_time:.3g} s would hold none"
        raise BadInput(what, channel="intensity", hint="give fewer frames or more time to each")
    count = options.frames or math.ceil(intensity.size / length - 1e-6)
    unlocated = to_sample_ranges(unrecoverable_intervals(result.motion, result.defects), intensity)
    edges = [min(round(k * length), intensity.size) for k in range(count + 1)]

    def pictures() -> Iterator[Picture]:
        for begin, end in pairwise(edges):
            yield grid_intensity(result.beam, intensity, result.picture.grid, unlocated, begin, end)

    write_frames(path, pictures(), count, frame_time)
    deviations = (replace(picture, image=pixel_sd(picture, result.sample_noise)) for picture in pictures())
    write_frames(path.with_name("frames_sd.ome.tif"), deviations, count, frame_time)
