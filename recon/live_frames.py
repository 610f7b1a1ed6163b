"""Frames of a recording that is being written, each in parts, so that little is left to do after its last sample.

A part is tracked from the state in which the part before it ended, and gridded onto the pixels of the frame. When the
last and short part has arrived, the picture follows from the sums.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from estimation.tracker import track_end
from recon.estimated_motion import EstimatedMotion
from recon.imaging.bidirectional_phase import slow_period
from recon.imaging.intensity_gridding import add_pictures, grid_intensity
from recon.imaging.picture import Grid, Picture
from recon.imaging.picture_estimate import (
    EstimatedPicture,
    grid_held_out,
    kernel_widths,
    picture_of_sums,
    picture_without_sd,
)
from recon.imaging.pixel_noise import SampleNoise, measure_noise
from recon.imaging.readout_phase import ReadoutPhase, apply_readout_phase, update_readout_phase
from recon.io.output import write_tiff
from recon.phase_and_drift import measure_phase_errors, wants_readout_phase
from recon.pipeline import estimate_motion
from recon.preparation import prepare_frame, select_device
from recon.quality.defects import unrecoverable_intervals
from recon.quality.sensor_noise import check_sensor_noise
from recon.reconstruction import Options
from recon.report.figures import save_picture
from recon.sample_ranges import to_sample_ranges
from scanner.device import Device
from scanner.files import replacing
from scanner.motion import AxisMotion, Motion
from scanner.recording import Recording

LAST_PART_PERIODS = 50.0
"""Periods of the slower axis in each of the last two parts of a frame: tracking one takes less time than it lasts."""

LEAD_IN_PERIODS = 30.0
"""Periods of the slower axis before a segment whose state no earlier one ended in; the motions then connect."""

NOISE_SAMPLES = 1 << 17
"""Samples of a frame from which its noise is measured, in some 10 ms: 10^4 pairs determine a variance to 1.5 %."""

MAX_FRAMES_BETWEEN_MEASUREMENTS = 64
"""Frames between two measurements of the readout's phase error: seconds, in which temperature changes it little."""

SIGN_TEST_SAMPLES = 4096
"""Samples over which the signs of two motions are compared."""


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
    """

    device: Device
    motion: Motion
    stop: float
    grid: Grid
    readout_phase: Mapping[str, ReadoutPhase]
    estimate: EstimatedPicture | None = None
    widths: list[float] | None = None
    frames: int = 0


@dataclass(frozen=True)
class FrameSums:
    """Gridded samples of a frame.

    Attributes:
        means: picture of the means of all samples. held: of those held out, None where none are.
        noise: of a sample, by detector.
    """

    means: Picture
    held: Picture | None
    noise: tuple[SampleNoise | None, ...]


def part_edges(start: float, stop: float, period: float) -> list[float]:
    """Return the edges [s] of the parts of a frame from ``start`` to ``stop``; period: of the slower axis [s]."""
    last = LAST_PART_PERIODS * period
    return [start, *(edge for edge in (stop - 2.0 * last, stop - last) if edge >= start + last), stop]


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
    sensed, intensity = estimated.motion, estimated.prepared.intensity
    known = scan.readout_phase if scan else {}
    estimated = replace(estimated, motion=apply_readout_phase(sensed, known))
    first = max(0, round((start - intensity.start) * intensity.sample_rate))
    unlocated = to_sample_ranges(unrecoverable_intervals(estimated.motion, estimated.prepared.defects), intensity)
    beam, grid = estimated.beam, estimated.grid
    means = grid_intensity(beam, intensity, grid, unlocated, first)
    held = None if options.picture == "mean" else grid_held_out(beam, intensity, grid, unlocated, first)
    if frame is None:
        frame = FrameSums(means, held, measure_noise(beam, intensity, grid, NOISE_SAMPLES, first))
    else:
        held = add_pictures(frame.held, held) if frame.held and held else None
        frame = replace(frame, means=add_pictures(frame.means, means), held=held)
    device = estimated.prepared.device
    if scan is None:
        return LiveScan(device, sensed, stop, grid, known), frame
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


def update_readout(recording: Recording, start: float, stop: float, scan: LiveScan, options: Options) -> LiveScan:
    """Measure the phase error of the readout in the frame from ``start`` to ``stop`` [s] where it is due."""
    if not (measures_readout_phase(scan.frames) and wants_readout_phase(scan.motion, options)):
        return scan
    estimated = _estimate_part(recording, start, stop, scan, options)
    sensed = estimated.motion
    estimated = replace(estimated, motion=apply_readout_phase(sensed, scan.readout_phase))
    errors = measure_phase_errors(estimated)
    return replace(scan, readout_phase=update_readout_phase(sensed, estimated.motion, errors, scan.readout_phase))


def measures_readout_phase(number: int) -> bool:
    """Whether the phase error of the readout is measured in the frame of this number, from 1 on.

    It takes longer than a short frame lasts. Frames at doubling numbers find it early and then refine it; in a long
    scan every ``MAX_FRAMES_BETWEEN_MEASUREMENTS`` follow it.
    """
    return number & (number - 1) == 0 or number % MAX_FRAMES_BETWEEN_MEASUREMENTS == 0


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
        prepared = prepare_frame(recording, device, start, stop, options.undo_lag)
        check_sensor_noise(prepared.recording, device, options.estimator)
        return estimate_motion(prepared, options)
    end = track_end(scan.motion) if scan.stop == start else None
    begin = start - LEAD_IN_PERIODS * slow_period(scan.motion) if end is None else min(end, start)
    prepared = prepare_frame(recording, device, begin, stop, options.undo_lag)
    estimated = estimate_motion(prepared, options, scan.motion, scan.grid)
    return replace(estimated, motion=match_signs(estimated.motion, scan.motion))


def _is_opposite(old: AxisMotion, new: AxisMotion) -> bool:
    """Whether the new motion has the opposite sign of the old one at its begin."""
    before, after = old.angle.phasors(), new.angle.phasors()
    if before is not None and after is not None:  # phasors can be extrapolated beyond the end of the old motion
        time = new.angle.start + np.arange(min(SIGN_TEST_SAMPLES, new.angle.size)) / new.angle.sample_rate
        return float(np.mean(np.cos(before.phase(time) - after.phase(time)))) < 0.0
    first = round((new.angle.start - old.angle.start) * old.angle.sample_rate)
    shared = min(SIGN_TEST_SAMPLES, max(old.angle.size - first, 0), new.angle.size)
    return float(np.nansum(old.angle.read(first, first + shared) * new.angle.read(0, shared))) < 0.0
