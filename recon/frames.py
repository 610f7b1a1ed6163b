"""The scan as a film: the pictures of successive stretches of time, by the motion that was found for the whole."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path

from recon.output import write_frames
from recon.pipeline import Options, Reconstruction, mapped
from recon.trouble import samples, unknown
from scanner.errors import BadInput


def film(path: Path, result: Reconstruction, options: Options) -> None:
    """Write ``options.frames`` frames, or one for each ``options.frame_time``, as OME-TIFF.

    The last frame of a given time may be shorter than the others.

    Raises:
        BadInput: frames of less than a sample.
    """
    frame_time = options.frame_time or result.recorded / (options.frames or 1)
    intensity = result.intensity
    length = frame_time * intensity.sample_rate
    if length < 1:
        what = f"has {intensity.sample_rate:.4g} samples a second, and frames of {frame_time:.3g} s would hold none"
        raise BadInput(what, channel="intensity", hint="give fewer frames or more time to each")
    count = options.frames or math.ceil(intensity.size / length - 1e-6)
    lost = samples(unknown(result.motion, result.trouble), intensity)
    edges = [min(round(k * length), intensity.size) for k in range(count + 1)]
    pictures = (
        mapped(result.motion, intensity, result.picture.grid, lost, begin, end)
        for begin, end in pairwise(edges)
    )
    write_frames(path, pictures, count, frame_time)
