"""From a recording to a picture: prepare, estimate, correct, grid, assess.

Each step is a function that takes what the step before returned (:func:`reconstruct` lists them).
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from estimation.estimate import estimate
from recon.evaluation import Truth, evaluate_axis
from recon.imaging.intensity_correction import add_drift_errors
from recon.imaging.intensity_gridding import find_visited_pixels, grid_intensity
from recon.imaging.picture import Grid, Picture, grid_of_scan
from recon.imaging.picture_kinds.picture_estimate import estimate_picture
from recon.imaging.pixel_noise import measure_noise
from recon.imaging.sample_motion.correction import describe_sample_motion, measure_sample_motion
from recon.imaging.sample_motion.motion_check import describe_unremoved_motion
from recon.imaging.saturation import detector_rails, sd_without_saturated
from recon.imaging.scan_phase.image_phase import refine_motion
from recon.imaging.scan_phase.start_shift import describe_start_shift
from recon.imaging.wild_samples import without_wild_samples
from recon.quality.amplitude_check import (
    amplitude_calibration,
    check_signal_units,
    compare_with_signal,
    describe_amplitude_contradictions,
)
from recon.quality.centre_motion import describe_centre_motion
from recon.quality.clock_jumps import mark_path_during_jumps
from recon.quality.defects import PHASE_JUMP, Defect, describe_defects, unlocated_samples
from recon.quality.drive_size import describe_drive_sizes
from recon.quality.dropped_samples import (
    TimingBreak,
    find_timing_break,
    find_timing_break_between,
    restore_timing,
    slices_aligned,
)
from recon.quality.gain_steps import describe_gain_steps
from recon.quality.overflow import describe_overflows
from recon.quality.resonance_check import describe_resonance_mismatch
from recon.quality.sensor_noise import check_sensor_noise
from recon.quality.sensor_sign import describe_unconfirmed_signs, without_contradicted_signs
from recon.quality.structure import describe_missing_structure
from recon.steps.estimated_motion import EstimatedMotion
from recon.steps.estimator_choice import choose_estimator
from recon.steps.field_check import check_field, check_units, own_half_angle
from recon.steps.intensity_notes import describe_coarse_sampling, describe_intensity
from recon.steps.lost_position_signals import find_lost_position_signals, leave_out_lost
from recon.steps.notes import (
    describe_clock_jumps,
    describe_limits,
    describe_long_frames,
    describe_motion,
    describe_unlocated,
)
from recon.steps.phase_and_drift import correct_phase_and_drift
from recon.steps.preparation import PreparedRecording, prepare, prepare_segment
from recon.steps.reconstruction import Options, Reconstruction
from recon.steps.registration_segments import registration_segments
from recon.steps.sign_after_rest import follow_signs
from scanner.channel import Channel
from scanner.device import AXES, Device
from scanner.errors import BadInput
from scanner.motion import Motion
from scanner.recording import Recording
from scanner.sample_ranges import SampleRanges, subtract_ranges, to_sample_ranges
from scanner.wording import counted


@dataclass(frozen=True)
class GriddedScan:
    """The picture of an estimated motion.

    Attributes:
        estimated: the motion.
        picture: mean intensity and sample count of each pixel.
        unlocated: samples left out because the mirror's angle is unknown there.
        affected: pixels that hold samples from defects, or were missed through a clock jump, shape (height, width).
        field_notes: on samples outside the field, a line each.
    """

    estimated: EstimatedMotion
    picture: Picture
    unlocated: SampleRanges
    affected: NDArray[np.bool_]
    field_notes: list[str] = field(default_factory=list)


def reconstruct(
    recording: Recording, options: Options, truth: Truth | None = None, quiet: bool = False
) -> Reconstruction:
    """Prepare a recording, estimate its motion, grid its intensity and assess the result.

    Args:
        recording: with an intensity and the channels that the estimator needs.
        options: estimator, resolution and further choices of the user.
        truth: of a simulation, for the evaluation.
        quiet: show no progress.

    Raises:
        BadInput: the recording or the device lacks what is needed.
    """
    began = time.perf_counter()
    prepared = prepare(recording, options.device)
    sensor_notes = check_sensor_noise(prepared.recording, prepared.device, options.estimator)
    result = _reconstruct_prepared(prepared, options, truth, quiet)
    result = _repair_dropped_samples(prepared, result, options, truth, quiet)
    if prepared.clock_jumps:
        result = replace(result, notes=[*result.notes, describe_clock_jumps(recording, prepared)])
    return replace(result, notes=[*result.notes, *sensor_notes], seconds=time.perf_counter() - began)


def _reconstruct_prepared(
    prepared: PreparedRecording, options: Options, truth: Truth | None, quiet: bool
) -> Reconstruction:
    """Estimate, grid and assess, with a progress bar."""
    with tqdm(total=4, desc="reconstruct", file=sys.stderr, leave=False, disable=quiet or None) as progress:
        estimator, choice_notes = options.estimator, list[str]()
        if estimator is None:
            estimator, choice_notes = choose_estimator(prepared, options)
        progress.set_postfix_str(estimator)
        estimated = estimate_motion(prepared, replace(options, estimator=estimator))
        progress.update()
        progress.set_postfix_str("registration")
        # The sample's motion does not depend on phase errors, which a moving sample would disturb: it comes first.
        estimated = correct_phase_and_drift(correct_sample_motion(estimated, options), options)
        progress.update()
        progress.set_postfix_str("gridding")
        gridded = grid_scan(estimated, options)
        progress.update()
        progress.set_postfix_str("assessment")
        result = assess(gridded, options, truth)
        progress.update()
    return replace(result, notes=[*choice_notes, *result.notes])


def estimate_motion(
    prepared: PreparedRecording, options: Options, before: Motion | None = None, grid: Grid | None = None
) -> EstimatedMotion:
    """Estimate the motion, and refine it by the phase errors that the picture shows where that helps.

    Args:
        prepared: the recording.
        options: estimator, flips and pixels.
        before: motion of an earlier segment of the same scan, from which the tracker continues.
        grid: the pixels of that segment, against which its motion was checked.

    Raises:
        BadInput: no such estimator, or the recording lacks what it needs, or a half angle is stated in another unit.
    """
    recording, device = prepared.recording, prepared.device
    motion = estimate(recording, device, options.estimator, options.flips, before)
    if before is None:
        check_signal_units(recording, device, motion)
    if grid is not None:
        motion, notes = refine_motion(recording, device, motion, prepared.intensity, grid, options.flips)
        return EstimatedMotion(prepared, motion, grid, [], notes)
    grid, _ = _picture_grid(device, motion, options)
    check_units(grid, motion)
    motion, notes = refine_motion(recording, device, motion, prepared.intensity, grid, options.flips)
    motion, sign_notes = follow_signs(motion, device, prepared.intensity, recording.origin)
    grid, field_notes = _picture_grid(device, motion, options)
    notes = [*notes, *sign_notes, *motion.notes, *describe_unconfirmed_signs(recording, device, motion)]
    notes += [*describe_resonance_mismatch(device, motion), *describe_drive_sizes(recording, device, motion)]
    motion = without_contradicted_signs(recording, device, motion)
    return _leave_out_lost_signals(EstimatedMotion(prepared, motion, grid, field_notes, notes))


def _leave_out_lost_signals(estimated: EstimatedMotion) -> EstimatedMotion:
    """The motion without the times at which position signals show a mirror at rest and the light shows motion."""
    prepared, motion = estimated.prepared, estimated.motion
    if motion.estimator != "sensor":
        return estimated
    lost = find_lost_position_signals(estimated.beam, prepared.intensity, estimated.grid)
    if not lost:
        return estimated
    motion, defects = leave_out_lost(motion, lost, prepared.recording)
    return replace(estimated, motion=motion, prepared=replace(prepared, defects=(*prepared.defects, *defects)))


def correct_sample_motion(estimated: EstimatedMotion, options: Options) -> EstimatedMotion:
    """Take the motion of the sample out of the beam's positions if it is asked for."""
    if not options.sample_motion:
        return estimated
    intensity = without_wild_samples(estimated.prepared.intensity, estimated.beam, estimated.grid)
    found = measure_sample_motion(estimated.beam, intensity, estimated.grid, _unlocated(estimated))
    notes = [*estimated.motion_notes, describe_sample_motion(found, intensity.sample_rate)]
    return replace(estimated, sample_motion=found, motion_notes=notes)


def grid_scan(estimated: EstimatedMotion, options: Options) -> GriddedScan:
    """Grid the intensity, and mark the pixels that defects affect.

    Raises:
        DeviceInvalid: most samples lie outside the field of view.
        BadInput: no sample was mapped.
    """
    prepared, beam, grid = estimated.prepared, estimated.beam, estimated.grid
    unlocated = _unlocated(estimated)
    picture = grid_intensity(beam, prepared.intensity, grid, unlocated)
    moved = estimated.sample_motion is not None and estimated.sample_motion.moving
    field_notes = check_field(picture, estimated.motion, options.allow_outside, moved, prepared.clock_notes)
    if not picture.coverage.any():
        hint = "check the channels' start times, and that the sensors recorded a motion throughout"
        raise BadInput("no sample was mapped: the angle is known nowhere", channel="intensity", hint=hint)
    defective = to_sample_ranges(((defect.start, defect.stop) for defect in prepared.defects), prepared.intensity)
    affected = find_visited_pixels(beam, subtract_ranges(defective, unlocated), grid)
    affected |= mark_path_during_jumps(beam, prepared.clock_jumps, grid)
    return GriddedScan(estimated, picture, unlocated, affected, field_notes)


def _describe_unremoved_motion(gridded: GriddedScan, intensity: Channel, options: Options) -> list[str]:
    """The line on a motion of the sample that was not to be removed; none of a stack, or where the beam is wrong.

    Args:
        gridded: the picture.
        intensity: without wild samples.
        options: of the user.
    """
    estimated = gridded.estimated
    if options.sample_motion or estimated.contradictions or estimated.prepared.position_z is not None:
        return []
    return describe_unremoved_motion(estimated.beam, intensity, estimated.grid, gridded.unlocated, options.p)


def assess(gridded: GriddedScan, options: Options, truth: Truth | None) -> Reconstruction:
    """Compare the motion with the truth if there is one, and collect the notes."""
    estimated, prepared = gridded.estimated, gridded.estimated.prepared
    motion, beam, intensity = estimated.motion, estimated.beam, prepared.intensity
    noise = add_drift_errors(measure_noise(beam, intensity, estimated.grid), estimated.intensity_drift)
    estimate = estimate_picture(options.picture, gridded.picture, noise, beam, intensity, gridded.unlocated)
    amplitude_checks = compare_with_signal(prepared.recording, prepared.device, motion)
    samples, angles = (beam, intensity, estimated.grid, gridded.unlocated), truth.angles if truth else {}
    cleaned = without_wild_samples(intensity, beam, estimated.grid)
    return Reconstruction(
        motion=motion,
        beam=beam,
        picture=estimate.picture,
        picture_kind=options.picture,
        picture_sd=sd_without_saturated(estimate.sd, *samples, detector_rails(intensity)),
        data_share=estimate.data_share,
        resolution_px=estimate.resolution_px,
        sample_noise=noise,
        amplitude_calibration=amplitude_calibration(prepared.recording, prepared.device, motion, amplitude_checks),
        p=options.p,
        spot=options.spot,
        phase_errors=estimated.phase_errors or [],
        readout_phase=estimated.readout_phase,
        estimator_phase_sd=estimated.estimator_phase_sd,
        intensity_drift=estimated.intensity_drift,
        sample_motion=estimated.sample_motion,
        evaluation={axis: evaluate_axis(motion.axes[axis], *angle) for axis, angle in angles.items()},
        truth=truth,
        defects=list(prepared.defects),
        unlocated_samples=sum(stop - first for first, stop in gridded.unlocated),
        affected=gridded.affected,
        limits=[
            *describe_overflows(prepared.uncorrected),
            *describe_gain_steps(prepared.uncorrected, prepared.device),
            *describe_limits(*samples, prepared.defects),
            *describe_start_shift(prepared.uncorrected, motion, estimated.contradictions),
            *describe_centre_motion(prepared.recording, prepared.device, motion, estimated.grid, options.p),
            *estimated.clock_limits,
            *_describe_unremoved_motion(gridded, cleaned, options),
            *describe_missing_structure(estimate, gridded.picture, beam, intensity, cleaned, gridded.unlocated),
        ],
        notes=[
            *estimated.field_notes,
            *gridded.field_notes,
            *prepared.clock_notes,
            *prepared.unknown_entries,
            *estimated.motion_notes,
            *describe_amplitude_contradictions(amplitude_checks),
            *describe_motion(motion, intensity),
            *describe_defects(prepared.defects),
            *describe_intensity(beam, intensity, estimated.grid),
            *describe_coarse_sampling(beam, intensity, estimated.grid),
            *estimate.notes,
            *describe_long_frames(options.frame_time, intensity),
            *describe_unlocated(gridded.unlocated, intensity),
        ],
        intensity=intensity,
        position_z=prepared.position_z,
        name=prepared.recording.name,
        clock_doubted=bool(prepared.clock_notes),
    )


def _repair_dropped_samples(
    prepared: PreparedRecording, result: Reconstruction, options: Options, truth: Truth | None, quiet: bool
) -> Reconstruction:
    """Reconstruct again with the timing restored if the picture shows that samples of the intensity were dropped."""
    timing_break = _find_timing_break(result)
    if timing_break is None:
        return result
    dropped, recorded = timing_break.dropped, prepared.uncorrected["intensity"]
    if dropped is not None:
        timed = restore_timing(prepared.uncorrected, dropped)
        restored = prepare_segment(timed, prepared.device, prepared.clock_jumps)
        repaired = _reconstruct_prepared(restored, options, truth, quiet)
        if slices_aligned(repaired.phase_errors, repaired.motion).all():
            start, stop = (recorded.start + at / recorded.sample_rate for at in (dropped.first, dropped.stop))
            number = counted(abs(dropped.missing), "sample")
            what = f"{number} lost" if dropped.missing > 0 else f"{number} too many"
            note = f"intensity: {what} at {start:.6g} s, as the picture shows; later samples were shifted back"
            defect = Defect("intensity", PHASE_JUMP, start, stop)
            return replace(repaired, defects=[*repaired.defects, defect], notes=[*repaired.notes, note])
    when = recorded.start + timing_break.sample / recorded.sample_rate
    doubt = (
        f"from about {when:.4g} s on the forward and backward half-periods disagree: the phase drifted away, samples "
        "of the intensity were lost, or the scene changed"
    )
    if result.limits:  # they state why the picture does not show the scene; this follows from them
        return replace(result, notes=[*result.notes, doubt])
    return replace(result, limits=[doubt])


def _find_timing_break(result: Reconstruction) -> TimingBreak | None:
    """Where the intensity loses its timing, as the picture shows; None where it does not, and for a stack."""
    segments = registration_segments(result.motion, result.intensity, result.position_z)
    scan = result.phase_errors, result.motion, result.intensity, result.picture.grid
    if len(segments) <= 1:
        return find_timing_break(*scan)
    if result.position_z is not None or not result.phase_errors:
        return None
    measured = sum(stop - first for first, stop in segments)
    return find_timing_break_between(*scan, measured // len(result.phase_errors))


def _unlocated(estimated: EstimatedMotion) -> SampleRanges:
    """Samples of the intensity during which the mirror's angle is unknown."""
    prepared = estimated.prepared
    return unlocated_samples(estimated.motion, estimated.beam, prepared.defects, prepared.intensity)


def _picture_grid(device: Device, motion: Motion, options: Options) -> tuple[Grid, list[str]]:
    """The pixels over the device's field of view, else over the range of the motion, with a note that says so."""
    if device.scan is not None:
        return grid_of_scan(*options.pixels, device.scan), []
    half = {axis: own_half_angle(motion.axes[axis]) for axis in AXES}
    note = (
        f"the device states no [scan]: the field is the motion's own, {half['x']:.4g} x {half['y']:.4g} rad half angles"
    )
    return Grid(*options.pixels, half["x"], half["y"]), [note]
