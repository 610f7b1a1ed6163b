"""Frames of a recording that is being written, each in parts, so that little is left to do after its last sample.

A part is tracked from the state in which the part before it ended, and its samples are added to the pixels. When
the last and short part has arrived, the picture follows from the sums. The phase error of the readout is measured in
one part of some frames, from samples in memory, so that another thread can do it meanwhile.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType

import numpy as np

from estimation.tracker import track_end
from recon.imaging.intensity_gridding import PixelSums, add_samples, add_scattered, empty_sums
from recon.imaging.picture import Grid, Picture
from recon.imaging.picture_kinds.held_out import held_out_ranges
from recon.imaging.picture_kinds.picture_estimate import (
    EstimatedPicture,
    kernel_widths,
    picture_of_sums,
    picture_without_sd,
)
from recon.imaging.pixel_noise import SampleNoise, measure_noise
from recon.imaging.scan_phase.bidirectional_phase import slow_period
from recon.imaging.scan_phase.carried_readout_phase import apply_readout_phase, update_readout_phase
from recon.imaging.scan_phase.readout_phase_model import ReadoutPhase
from recon.io.output import write_tiff
from recon.pipeline import estimate_motion
from recon.quality.defects import unrecoverable_intervals
from recon.quality.sensor_noise import check_sensor_noise
from recon.report.figures import save_picture
from recon.steps.estimated_motion import EstimatedMotion
from recon.steps.phase_and_drift import measure_picture_phase_errors, wants_readout_phase
from recon.steps.preparation import prepare_frame, select_device
from recon.steps.reconstruction import Options
from recon.steps.registration_segments import MAX_REGISTERED_PERIODS
from scanner.channel import Channel
from scanner.device import Device
from scanner.files import replacing
from scanner.motion import AxisMotion, Motion
from scanner.recording import Recording
from scanner.sample_ranges import subtract_ranges, to_sample_ranges

LAST_PART_PERIODS = 50.0
"""Periods of the slower axis in each of the last two parts of a frame: tracking one takes less time than it lasts. The
parts before them last twice, four times as long, and so on."""

LEAD_IN_PERIODS = 30.0
"""Periods of the slower axis before a segment whose state no earlier one ended in; the motions then connect."""

NOISE_SAMPLES = 1 << 17
"""Samples of a frame from which its noise is measured, in some 10 ms: 10^4 pairs determine a variance to 1.5 %."""

MAX_FRAMES_BETWEEN_MEASUREMENTS = 64
"""Frames between two measurements of the readout's phase error: seconds, in which temperature changes it little."""

SIGN_TEST_SAMPLES = 4096
"""Samples over which the signs of two motions are compared that have no phase."""


@dataclass(frozen=True)
class LiveScan:
    """What a part of a frame takes over from those before it.

    Attributes:
        device: in use.
        motion: of the mirror in the part before.
        stop: end of that part [s].
        grid: shared by all frames.
        readout_phase: phase error of the readout by axis, from all frames so far.
        estimate: picture of the frame before; None in the first frame.
        widths: of the kernel by detector [px], as that frame's samples chose them; None where there are none.
        frames: number of complete frames.
        measure_at: number of complete frames from which the readout's phase error is measured next.
    """

    device: Device
    motion: Motion
    stop: float
    grid: Grid
    readout_phase: Mapping[str, ReadoutPhase]
    estimate: EstimatedPicture | None = None
    widths: list[float] | None = None
    frames: int = 0
    measure_at: int = 1


@dataclass(frozen=True)
class FramePart:
    """A part of a frame whose samples can be read after the recording was closed.

    Attributes:
        sensed: motion by the sense signal alone.
        estimated: the motion that was used, with the beginning of the intensity in memory.
        duration: of the part [s].
    """

    sensed: Motion
    estimated: EstimatedMotion
    duration: float


@dataclass(frozen=True)
class FrameSums:
    """Gridded samples of a frame.

    Attributes:
        grid: the pixels. intensity: the channel of the samples.
        sums: of all samples. held_sums: of those held out, None where none are.
        noise: of a sample, by detector.
        longest: the longest part of the frame.
    """

    grid: Grid
    intensity: Channel
    sums: PixelSums
    held_sums: PixelSums | None
    noise: tuple[SampleNoise | None, ...]
    longest: FramePart

    @cached_property
    def means(self) -> Picture:
        """Picture of the means of all samples; of a complete frame, because it is computed once."""
        return self.sums.picture(self.intensity, self.grid)

    @cached_property
    def held(self) -> Picture | None:
        """Picture of the means of the samples held out; of a complete frame."""
        return None if self.held_sums is None else self.held_sums.picture(self.intensity, self.grid)


def part_edges(start: float, stop: float, period: float) -> list[float]:
    """Return the edges [s] of the parts of a frame from ``start`` to ``stop``; period: of the slower axis [s]."""
    last = LAST_PART_PERIODS * period
    edges, length = [stop], last
    while stop - length >= start + last:
        edges.append(stop - length)
        length *= 2.0
    return [start, *reversed(edges)]


def add_part(
    recording: Recording, start: float, stop: float, scan: LiveScan | None, frame: FrameSums | None, options: Options
) -> tuple[LiveScan, FrameSums]:
    """Track the recording from ``start`` to ``stop`` [s] and add its samples to a frame.

    Args:
        recording: up to its current end.
        start, stop: of the part [s].
        scan: None for the first part of all.
        frame: samples of the frame's parts before; None for its first part.
        options: as for :func:`recon.pipeline.reconstruct`.

    Raises:
        BadInput: the motion cannot be estimated, or in the first part a sensor holds only noise.
    """
    estimated = _estimate_part(recording, start, stop, scan, options)
    sensed = estimated.motion
    intensity = estimated.prepared.for_picture(options.undo_lag).intensity
    known = scan.readout_phase if scan else {}
    estimated = replace(estimated, motion=apply_readout_phase(sensed, known))
    first = intensity.sample_from(start)
    unlocated = to_sample_ranges(unrecoverable_intervals(estimated.motion, estimated.prepared.defects), intensity)
    beam, grid = estimated.beam, estimated.grid
    if frame is None:
        held = None if options.picture == "mean" else empty_sums(intensity, grid)
        noise = measure_noise(beam, intensity, grid, NOISE_SAMPLES, first)
        longest = keep_part(sensed, estimated, stop - start)
        frame = FrameSums(grid, intensity, empty_sums(intensity, grid), held, noise, longest)
    elif stop - start > frame.longest.duration:
        frame = replace(frame, longest=keep_part(sensed, estimated, stop - start))
    located = subtract_ranges([(first, intensity.size)], unlocated)
    frame = replace(frame, sums=add_samples(frame.sums, beam, intensity, grid, located))
    if frame.held_sums is not None:
        held_out = subtract_ranges(held_out_ranges(first, intensity.size), unlocated)
        frame = replace(frame, held_sums=add_scattered(frame.held_sums, beam, intensity, grid, held_out))
    if scan is None:
        return LiveScan(estimated.prepared.device, sensed, stop, grid, known), frame
    return replace(scan, motion=sensed, stop=stop), frame


def first_picture(scan: LiveScan, frame: FrameSums, options: Options) -> Picture | None:
    """Return the picture of a complete frame before its standard deviation is known; None if that is no faster.

    Raises:
        BadInput: as :func:`finish_frame`.
    """
    return picture_without_sd(options.picture, frame.means, frame.held, frame.noise, scan.widths)


def finish_frame(scan: LiveScan, frame: FrameSums, options: Options) -> LiveScan:
    """Make the picture of a complete frame with its standard deviation; a kernel is that of the frame before.

    Raises:
        BadInput: the samples determine no picture of the wanted kind.
    """
    before = None if options.independent_frames else scan.estimate
    estimate = picture_of_sums(options.picture, frame.means, frame.held, frame.noise, before, scan.widths)
    held = frame.held if options.picture == "kernel" else None
    widths = None if held is None else kernel_widths(frame.means, held, frame.noise)
    return replace(scan, estimate=estimate, widths=widths, frames=scan.frames + 1)


def keep_part(sensed: Motion, estimated: EstimatedMotion, duration: float) -> FramePart:
    """Return a part of a frame with the samples in memory in which the phase error of the readout can be measured."""
    prepared = estimated.prepared
    start = prepared.intensity.start
    cut = prepared.recording.part(start, start + MAX_REGISTERED_PERIODS * slow_period(sensed))
    channels = {
        name: replace(channel, raw=channel.stored(), first=0, stop=channel.size)
        for name, channel in cut.channels.items()
        if name in ("intensity", "position_z")
    }
    recording = replace(cut, channels=MappingProxyType(channels))
    prepared = replace(prepared, recording=recording, lagging=recording["intensity"], uncorrected=recording)
    return FramePart(sensed, replace(estimated, prepared=prepared), duration)


def wants_measurement(scan: LiveScan, options: Options) -> bool:
    """Whether the phase error of the readout is to be measured in the frame that was completed last."""
    return scan.frames >= scan.measure_at and wants_readout_phase(scan.motion, options)


def measure_readout(part: FramePart, known: Mapping[str, ReadoutPhase]) -> Mapping[str, ReadoutPhase]:
    """Phase error of the readout by axis, from a part of a frame and from what is known by earlier frames.

    Raises:
        BadInput: the samples cannot be used.
    """
    errors = measure_picture_phase_errors(part.estimated)
    return update_readout_phase(part.sensed, part.estimated.motion, errors, known)


def next_measurement(number: int) -> int:
    """Return the frame in which the readout is measured next; number: frame in which a measurement ended, from 1 on.

    A measurement takes longer than a short frame lasts. Frames at doubling numbers find the phase error early and then
    refine it; in a long scan every ``MAX_FRAMES_BETWEEN_MEASUREMENTS`` follow it.
    """
    return min(2 * number, number + MAX_FRAMES_BETWEEN_MEASUREMENTS)


def match_signs(motion: Motion, before: Motion) -> Motion:
    """Return the motion with the signs of the previous one on axes whose own signal leaves the sign ambiguous."""
    axes = {}
    for name, axis in motion.axes.items():
        invert = axis.sign == "ambiguous" and _is_opposite(before.axes[name], axis)
        axes[name] = axis.negated() if invert else axis
    return replace(motion, axes=axes)


def replace_picture(output: Path, picture: Picture) -> None:
    """Replace image.tif, and remove the summary.json of an older run."""
    output.mkdir(exist_ok=True)
    (output / "summary.json").unlink(missing_ok=True)
    with replacing(output / "image.tif") as path:
        write_tiff(path, picture.image, picture.grid)


def replace_display_and_sd(output: Path, estimate: EstimatedPicture) -> None:
    """Replace image.png and image_sd.tif."""
    with replacing(output / "image.png") as path:
        save_picture(path, estimate.picture)
    with replacing(output / "image_sd.tif") as path:
        write_tiff(path, estimate.sd, estimate.picture.grid)


def _estimate_part(
    recording: Recording, start: float, stop: float, scan: LiveScan | None, options: Options
) -> EstimatedMotion:
    """The motion from ``start`` to ``stop`` [s], continued from the part before if it ended at ``start``."""
    device = scan.device if scan else select_device(recording, options.device)
    if scan is None:
        prepared = prepare_frame(recording, device, start, stop)
        check_sensor_noise(prepared.recording, device, options.estimator)
        return estimate_motion(prepared, options)
    end = track_end(scan.motion) if scan.stop == start else None
    begin = start - LEAD_IN_PERIODS * slow_period(scan.motion) if end is None else min(end, start)
    prepared = prepare_frame(recording, device, begin, stop)
    estimated = estimate_motion(prepared, options, scan.motion, scan.grid)
    return replace(estimated, motion=match_signs(estimated.motion, scan.motion))


def _is_opposite(old: AxisMotion, new: AxisMotion) -> bool:
    """Whether the new motion has the opposite sign of the old one at its begin."""
    before, after = old.angle.phasors(), new.angle.phasors()
    if before is not None and after is not None:  # phasors can be extrapolated beyond the end of the old motion
        time = np.array([new.angle.start])
        return float(np.cos(before.phase(time) - after.phase(time))[0]) < 0.0
    first = round((new.angle.start - old.angle.start) * old.angle.sample_rate)
    shared = min(SIGN_TEST_SAMPLES, max(old.angle.size - first, 0), new.angle.size)
    return float(np.nansum(old.angle.read(first, first + shared) * new.angle.read(0, shared))) < 0.0
