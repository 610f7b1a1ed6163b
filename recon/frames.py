"""Frames of a scan: pictures of successive parts of the time, with the motion of the whole scan."""

from __future__ import annotations

import math
import pickle
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from recon.imaging.intensity_gridding import grid_intensity
from recon.imaging.picture import Picture, fill_holes
from recon.imaging.picture_estimate import EstimatedPicture, estimate_picture
from recon.io.ome_zarr import write_ome_zarr
from recon.io.output import write_frames
from recon.quality.defects import unrecoverable_intervals
from recon.reconstruction import Options, Reconstruction
from recon.report.movie import write_movie
from recon.sample_ranges import SampleRanges, to_sample_ranges
from scanner.errors import BadInput

if TYPE_CHECKING:
    import xarray


@dataclass(frozen=True)
class ScanFrames:
    """The frames of a scan. They are computed each time that they are iterated over, one at a time.

    Attributes:
        result: the reconstruction of the whole scan.
        frame_time: time from one frame to the next [s].
        edges: first sample of each frame, and the end of the last one.
        unlocated: samples that belong to no pixel.
        independent: frames of posterior pictures use no samples of earlier frames.
    """

    result: Reconstruction
    frame_time: float
    edges: Sequence[int]
    unlocated: SampleRanges
    independent: bool = False

    def __len__(self) -> int:
        return len(self.edges) - 1

    def __iter__(self) -> Iterator[Picture]:
        for frame in self.estimates():
            yield frame.picture

    def estimates(self) -> Iterator[EstimatedPicture]:
        """Yield the frames with their standard deviations, in the kind of the reconstruction's picture.

        A frame with too few samples for a picture of this kind is NaN. Unless ``independent``, a posterior picture uses
        the samples of earlier frames where they agree with its own.
        """
        result, before = self.result, None
        for begin, end in pairwise(self.edges):
            means = grid_intensity(result.beam, result.intensity, result.picture.grid, self.unlocated, begin, end)
            data = result.beam, result.intensity, self.unlocated, begin, end
            try:
                frame = estimate_picture(result.picture_kind, means, result.sample_noise, *data, before)
            except BadInput:
                nothing = np.full(means.image.shape, np.nan, np.float32)
                yield EstimatedPicture(replace(means, image=nothing), nothing)
                continue
            yield frame
            before = None if self.independent else frame

    @property
    def times(self) -> list[float]:
        """Beginning of each frame on the recording's clock [s]."""
        intensity = self.result.intensity
        return [intensity.start + edge / intensity.sample_rate for edge in self.edges[:-1]]

    def to_xarray(self) -> xarray.Dataset:
        """Return all frames as an xarray dataset: ``image``, ``image_sd`` and ``coverage`` over time, y and x.

        Raises:
            BadInput: xarray is not installed.
        """
        from scanner.extras import import_extra

        xr = import_extra("xarray", "xarray")
        parts = []
        for frame, time in zip(self.estimates(), self.times, strict=True):
            part = frame.picture.to_xarray().assign(image_sd=frame.sd_picture.to_xarray()["image"])
            parts.append(part.expand_dims(time=[time]))
        frames: xarray.Dataset = xr.concat(parts, "time")
        frames["time"].attrs = {"units": "s", "long_name": "beginning of the frame"}
        frames["image"].attrs["units"] = frames["image_sd"].attrs["units"] = self.result.intensity.unit
        return frames


def frames(
    result: Reconstruction, count: int | None = None, frame_time: float | None = None, independent: bool = False
) -> ScanFrames:
    """Return the frames of a reconstructed scan.

    Args:
        result: of :func:`lissajous.reconstruct`.
        count: number of frames, or
        frame_time: duration of a frame [s]; the last one may be shorter.
        independent: posterior pictures use no samples of earlier frames.

    Raises:
        BadInput: a frame would hold less than one sample.
    """
    intensity = result.intensity
    time = frame_time or result.duration / (count or 1)
    length = time * intensity.sample_rate
    if length < 1:
        what = f"has {intensity.sample_rate:.4g} samples a second, and frames of {time:.3g} s would hold none"
        raise BadInput(what, channel="intensity", hint="give fewer frames or more time to each")
    number = count or math.ceil(intensity.size / length - 1e-6)
    unlocated = to_sample_ranges(unrecoverable_intervals(result.motion, result.defects), intensity)
    edges = [min(round(k * length), intensity.size) for k in range(number + 1)]
    return ScanFrames(result, time, edges, unlocated, independent)


def write_scan_frames(folder: Path, result: Reconstruction, options: Options) -> None:
    """Write the frames of ``options.frames`` or ``options.frame_time`` and their standard deviations.

    With ``options.fill_radius`` the frames with holes filled are written too, and shown in the movie.

    Args:
        folder: for ``frames.ome.tif``, ``frames_sd.ome.tif`` and what the options ask for.
        result: the reconstruction of the whole scan.
        options: ``frames``, ``frame_time``, ``independent_frames``, ``fill_radius``, ``zarr`` and ``movie``.

    Raises:
        BadInput: a frame would hold less than one sample.
    """
    own = frames(result, options.frames, options.frame_time, options.independent_frames)
    count, frame_time = len(own), own.frame_time
    with tempfile.TemporaryFile(dir=folder) as stored:  # on disk: all frames of a long recording exceed the memory
        for frame in own.estimates():
            pickle.dump((frame.picture, frame.sd), stored)

        def pairs() -> Iterator[tuple[Picture, NDArray[np.float32]]]:
            stored.seek(0)
            for _ in range(count):
                yield pickle.load(stored)

        def filled() -> Iterator[Picture]:
            for picture, _ in pairs():
                yield replace(picture, image=fill_holes(picture, options.fill_radius)[0])

        write_frames(folder / "frames.ome.tif", (picture for picture, _ in pairs()), count, frame_time)
        deviations = (replace(picture, image=sd) for picture, sd in pairs())
        write_frames(folder / "frames_sd.ome.tif", deviations, count, frame_time)
        if options.fill_radius:
            write_frames(folder / "frames_filled.ome.tif", filled(), count, frame_time)
        if options.zarr:
            write_ome_zarr(folder / "frames.ome.zarr", pairs(), count, frame_time)
        if options.movie:
            shown = filled() if options.fill_radius else (picture for picture, _ in pairs())
            low, high = np.nanpercentile(result.picture.image, [0.5, 99.5])
            write_movie(folder / f"frames.{options.movie}", shown, own.times, frame_time, (float(low), float(high)))
