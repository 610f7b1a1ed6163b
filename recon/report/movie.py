"""Frames as a movie (MP4 or GIF) with a scale bar and the time or the position z of each."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.imaging.frame_axis import FrameAxis, format_positions
from recon.imaging.picture import Picture
from recon.report.figures import to_rgb
from recon.report.reconstruction import scale_bar
from scanner.errors import BadInput

MIN_SIDE_PX = 400
"""Smaller frames are enlarged by a whole factor to this width at least, so that their labels can be read."""

MAX_RATE_HZ = 30.0
"""Largest number of frames per second of a movie. A faster scan is shown in slow motion."""


SLICE_RATE_HZ = 5.0
"""Number of slices or repeats of a stack per second of a movie: slow enough to compare each with the next."""


def write_movie(path: Path, frames: Iterable[Picture], axis: FrameAxis, limits: tuple[float, float]) -> None:
    """Write frames as ``.mp4`` or ``.gif``; detectors are averaged.

    Args:
        path: its suffix is the format.
        frames: pictures of one shape; one at a time is in memory for MP4.
        axis: time or position of each frame, for its label.
        limits: intensities shown black and white.

    Raises:
        BadInput: OpenCV was built without an encoder.
    """
    if axis.timed:
        rate = min(1.0 / axis.step, MAX_RATE_HZ)
        labels = [f"{1e3 * time:.4g} ms" if time < 1.0 else f"{time:.3f} s" for time in axis.values]
    elif axis.name == "t":
        rate, labels = SLICE_RATE_HZ, [f"{number + 1} of {len(axis.values)}" for number in range(len(axis.values))]
    else:
        rate = SLICE_RATE_HZ
        labels = [f"z = {z} um" for z in format_positions(axis.values)]
    pictures = (draw_frame(frame, label, limits) for frame, label in zip(frames, labels, strict=True))
    if path.suffix == ".gif":
        import imageio.v3 as iio

        iio.imwrite(path, list(pictures), duration=1e3 / rate, loop=0)
        return
    writer = None
    for picture in pictures:
        if writer is None:
            size = picture.shape[1], picture.shape[0]
            writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), rate, size)
            if not writer.isOpened():
                raise BadInput("this OpenCV writes no MP4", channel="--movie", hint="use --movie gif")
        writer.write(picture[..., ::-1])
    if writer is not None:
        writer.release()


def draw_frame(picture: Picture, label: str, limits: tuple[float, float]) -> NDArray[np.uint8]:
    """A frame with scale bar and label as RGB, sides of even length for the encoder."""
    rgb = to_rgb(picture.image, limits)
    factor = max(1, -(-MIN_SIDE_PX // rgb.shape[1]))
    rgb = rgb.repeat(factor, axis=0).repeat(factor, axis=1)
    rgb = np.pad(rgb, ((0, rgb.shape[0] % 2), (0, rgb.shape[1] % 2), (0, 0)))
    bar, length = scale_bar(picture.grid)
    _write(rgb, label, (10, 24))
    bottom, end = rgb.shape[0] - 12, 10 + round(factor * picture.grid.width * length)
    cv2.rectangle(rgb, (10, bottom - 4), (end, bottom), (255, 255, 255), -1)
    cv2.rectangle(rgb, (9, bottom - 5), (end + 1, bottom + 1), (0, 0, 0), 1)
    _write(rgb, bar.replace("µ", "u"), (10, bottom - 10))  # OpenCV draws ASCII alone
    return rgb


def _write(rgb: NDArray[np.uint8], text: str, at: tuple[int, int]) -> None:
    """White text with a black outline, at its lower left corner."""
    for colour, thickness in (((0, 0, 0), 3), ((255, 255, 255), 1)):
        cv2.putText(rgb, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.55, colour, thickness, cv2.LINE_AA)
