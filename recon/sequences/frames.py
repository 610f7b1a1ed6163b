"""Frames of a scan: pictures of successive parts of the time or of slices in z, with the motion of the whole scan."""

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

from recon.imaging.frame_axis import FrameAxis, position_axis
from recon.imaging.intensity_correction import add_drift_errors
from recon.imaging.intensity_gridding import grid_intensity
from recon.imaging.picture import Picture, fill_holes
from recon.imaging.picture_kinds.picture_estimate import EstimatedPicture, estimate_picture
from recon.imaging.pixel_noise import MAX_NOISE_SAMPLES, SampleNoise, measure_noise
from recon.imaging.saturation import detector_rails, sd_without_saturated
from recon.io.ome_zarr import write_ome_zarr
from recon.io.output import write_frames
from recon.quality.defects import unrecoverable_intervals
from recon.report.movie import write_movie
from recon.steps.reconstruction import Options, Reconstruction
from recon.steps.z_slices import ZSlices, find_z_slices
from scanner.arguments import check_numbers, check_type, check_whole_numbers
from scanner.errors import BadInput
from scanner.sample_ranges import SampleRanges, to_sample_ranges

if TYPE_CHECKING:
    import xarray


MAX_OWN_NOISE_RELATIVE_SD = 0.05
"""Relative standard error of the variance of a sample up to which a frame's own noise is used: its standard deviations
are then uncertain by 2.5 %. In a shorter frame the noise of the whole recording, from more pairs, is nearer."""


@dataclass(frozen=True)
class ScanFrames:
    """The frames of a scan. They are computed each time that they are iterated over, one at a time.

    Attributes:
        result: the reconstruction of the whole scan.
        axis: time or position z of each frame.
        spans: first sample of each frame, and the end of its last one.
        unlocated: samples that belong to no pixel.
        independent: frames of posterior pictures use no samples of earlier frames.
        slices: samples of each slice of a stack, whose frames are always independent; None for frames over time.
    """

    result: Reconstruction
    axis: FrameAxis
    spans: Sequence[tuple[int, int]]
    unlocated: SampleRanges
    independent: bool = False
    slices: ZSlices | None = None

    def __len__(self) -> int:
        return len(self.spans)

    def __iter__(self) -> Iterator[Picture]:
        for frame in self.estimates():
            yield frame.picture

    def estimates(self) -> Iterator[EstimatedPicture]:
        """Yield the frames with their standard deviations, in the kind of the reconstruction's picture.

        A frame with too few samples for a picture of this kind is NaN. Unless ``independent``, a posterior picture uses
        the samples of earlier frames where they agree with its own.
        """
        result, before = self.result, None
        grid, intensity = result.picture.grid, result.intensity
        rails = detector_rails(intensity)
        for number, (begin, end) in enumerate(self.spans):
            if self.slices is not None:
                intensity = self.slices.intensity_of(number, result.intensity)
            own = measure_noise(result.beam, intensity, grid, min(end - begin, MAX_NOISE_SAMPLES), begin)
            own = add_drift_errors(own, result.intensity_drift)
            noise = own if self.slices is not None else _choose_noise(own, result.sample_noise)
            means = grid_intensity(result.beam, intensity, grid, self.unlocated, begin, end)
            data = result.beam, intensity, self.unlocated, begin, end
            try:
                frame = estimate_picture(result.picture_kind, means, noise, *data, before)
            except BadInput:
                nothing = np.full(means.image.shape, np.nan, np.float32)
                yield EstimatedPicture(replace(means, image=nothing), nothing)
                continue
            place = result.beam, intensity, grid, self.unlocated
            yield replace(frame, sd=sd_without_saturated(frame.sd, *place, rails, begin, end))
            before = None if self.independent or self.slices else frame

    @property
    def frame_time(self) -> float | None:
        """Time from one frame to the next [s]; None for slices."""
        return self.axis.step if self.slices is None else None

    @property
    def times(self) -> list[float]:
        """Beginning of each frame, or time of the first sample of each slice, on the recording's clock [s]."""
        intensity = self.result.intensity
        return [intensity.start + begin / intensity.sample_rate for begin, _ in self.spans]

    @property
    def z(self) -> list[float] | None:
        """Position of each slice, increasing [m]; None for frames over time."""
        return None if self.slices is None else list(self.slices.positions)

    def to_xarray(self) -> xarray.Dataset:
        """Return all frames as an xarray dataset: ``image``, ``image_sd`` and ``coverage`` over time or z, y and x.

        Raises:
            BadInput: xarray is not installed.
        """
        from scanner.extras import import_extra

        xr = import_extra("xarray", "xarray")
        parts = []
        dimension, unit, what = "time", "s", "beginning of the frame"
        if self.slices is not None:
            dimension, unit, what = "z", "m", "position of the slice"
        for frame, value in zip(self.estimates(), self.axis.values, strict=True):
            part = frame.picture.to_xarray().assign(image_sd=frame.sd_picture.to_xarray()["image"])
            parts.append(part.expand_dims({dimension: [value]}))
        frames: xarray.Dataset = xr.concat(parts, dimension)
        frames[dimension].attrs = {"units": unit, "long_name": what}
        frames["image"].attrs["units"] = frames["image_sd"].attrs["units"] = self.result.intensity.unit
        return frames


def _choose_noise(
    own: Sequence[SampleNoise | None], of_recording: Sequence[SampleNoise | None]
) -> tuple[SampleNoise | None, ...]:
    """The noise of a frame's samples by detector: its own where the frame determines it.

    That of the recording holds the difference between passes far apart in time, of a scene that changed.
    """
    return tuple(
        frame if frame is not None and frame.relative_sd <= MAX_OWN_NOISE_RELATIVE_SD else whole
        for frame, whole in zip(own, of_recording, strict=True)
    )


def frames(
    result: Reconstruction,
    count: int | None = None,
    frame_time: float | None = None,
    independent: bool = False,
    z_step: float | None = None,
) -> ScanFrames:
    """Return the frames of a reconstructed scan: parts of the time, or slices in z.

    Without ``count`` and ``frame_time`` a recording with a channel ``position_z`` gives a slice for each position at
    which z rests, and any other a single frame.

    Args:
        result: of :func:`lissajous.reconstruct`.
        count: number of frames, or
        frame_time: duration of a frame [s]; the last one may be shorter.
        independent: posterior pictures use no samples of earlier frames; those of slices never do.
        z_step: thickness of a slice [m]: samples are sorted by z, whether it rests or not.

    Raises:
        BadInput: ``result`` is no result; a number is not positive, or ``count`` is not whole; both count and time are
            given; a frame or a slice would hold less than one sample; slices are asked for, and ``position_z`` is
            missing or does not rest.
    """
    check_type(Reconstruction, "give what lissajous.reconstruct returns", result=result)
    for name, value in (("count", count), ("frame_time", frame_time), ("z_step", z_step)):
        if value is None:
            continue
        (check_whole_numbers if name == "count" else check_numbers)(**{name: value})
        if not 0.0 < value < math.inf:
            raise BadInput(f"is {value}", channel=name, hint="give a positive number")
    if count is not None and frame_time is not None:
        raise BadInput("is given beside a count", channel="frame_time", hint="give one of the two")
    intensity = result.intensity
    unlocated = to_sample_ranges(unrecoverable_intervals(result.motion, result.defects), intensity)
    if z_step is not None and (count or frame_time):
        raise BadInput("sorts the samples by z, not by time", channel="z_step", hint="leave out the frames or the step")
    if z_step is not None and result.position_z is None:
        raise BadInput("is not in the recording", channel="position_z", hint="record the position of the objective")
    if result.position_z is not None and not (count or frame_time):
        slices = find_z_slices(result.position_z, intensity, z_step)
        return ScanFrames(result, position_axis(slices.positions), slices.spans, unlocated, True, slices)
    time = frame_time or result.duration / (count or 1)
    length = time * intensity.sample_rate
    if length < 1:
        what = f"has {intensity.sample_rate:.4g} samples a second, and frames of {time:.3g} s would hold none"
        raise BadInput(what, channel="intensity", hint="give fewer frames or more time to each")
    # A last frame begins at least half a sample before the end, so that it holds one.
    number = count or max(1, math.ceil((intensity.size - 0.5) / length - 1e-6))
    edges = [*(round(k * length) for k in range(number)), intensity.size]
    times = [intensity.start + edge / intensity.sample_rate for edge in edges[:-1]]
    return ScanFrames(result, FrameAxis("t", times, time), list(pairwise(edges)), unlocated, independent)


def write_scan_frames(folder: Path, result: Reconstruction, options: Options) -> ScanFrames:
    """Write the frames that the options ask for and their standard deviations; return them.

    With ``options.fill_radius`` the frames with holes filled are written too, and shown in the movie.

    Args:
        folder: for ``frames.ome.tif``, ``frames_sd.ome.tif`` and what the options ask for.
        result: the reconstruction of the whole scan.
        options: ``frames``, ``frame_time``, ``z_stack``, ``z_step``, ``independent_frames``, ``fill_radius``, ``zarr``
            and ``movie``.

    Raises:
        BadInput: as :func:`frames`.
    """
    if options.wants_stack and result.position_z is None:
        raise BadInput("has no sample in the part of the recording that is used", channel="position_z")
    own = frames(result, options.frames, options.frame_time, options.independent_frames, options.z_step)
    axis = own.axis
    with tempfile.TemporaryFile(dir=folder) as stored:  # on disk: all frames of a long recording exceed the memory
        for frame in own.estimates():
            pickle.dump((frame.picture, frame.sd), stored)

        def pairs() -> Iterator[tuple[Picture, NDArray[np.float32]]]:
            stored.seek(0)
            for _ in range(len(own)):
                yield pickle.load(stored)

        def filled() -> Iterator[Picture]:
            for picture, _ in pairs():
                yield replace(picture, image=fill_holes(picture, options.fill_radius)[0])

        write_frames(folder / "frames.ome.tif", (picture for picture, _ in pairs()), axis)
        deviations = (replace(picture, image=sd) for picture, sd in pairs())
        write_frames(folder / "frames_sd.ome.tif", deviations, axis)
        if options.fill_radius:
            write_frames(folder / "frames_filled.ome.tif", filled(), axis)
        if options.zarr:
            write_ome_zarr(folder / "frames.ome.zarr", pairs(), axis)
        if options.movie:
            shown = filled() if options.fill_radius else (picture for picture, _ in pairs())
            # Slices show different scenes, which differ from their mean more than successive frames do.
            compared = [result.picture.image] if own.slices is None else (picture.image for picture, _ in pairs())
            known = (image[np.isfinite(image)] for image in compared)
            limits = np.array([[0.0, 1.0]])
            if ranges := [np.percentile(values, [0.5, 99.5]) for values in known if values.size]:
                limits = np.array(ranges)
            shades = float(limits[:, 0].min()), float(limits[:, 1].max())
            write_movie(folder / f"frames.{options.movie}", shown, axis, shades)
    return own
