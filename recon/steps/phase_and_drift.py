"""The phase error of the readout and the drift of the detector, each measured in the picture without the other.

A drift of the detector makes samples of one place at two times differ, as a phase error does. The phase measured beside
a drift is less accurate or refuted, so it is measured again in the intensity without the drift.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from estimation.sensor_hum import LineBlock
from recon.imaging.flicker import describe_flicker, find_flicker, without_flicker
from recon.imaging.intensity_correction import (
    correct_drift,
    describe_drift,
    exceeds_uncertainty,
    measure_intensity_drift,
)
from recon.imaging.intensity_drift import IntensityDrift
from recon.imaging.intensity_drift_equations import DriftKind
from recon.imaging.scan_phase.bidirectional_phase import measure_motion_phase_errors
from recon.imaging.scan_phase.clock_rate import (
    converge_clock_error,
    describe_clock_error,
    find_clock_error,
    include_clock_error,
)
from recon.imaging.scan_phase.contradicted_phase import include_contradictions
from recon.imaging.scan_phase.detector_offset import (
    describe_unstated_place,
    one_direction_axes,
    remove_detector_offsets,
    stated_event,
)
from recon.imaging.scan_phase.phase_agreement import Contradiction, find_contradictions
from recon.imaging.scan_phase.phase_error import PhaseError
from recon.imaging.scan_phase.readout_phase import (
    MIN_DRIFT_SLICES,
    describe_readout_phase,
    remove_readout_phase,
    widen_undetermined,
)
from recon.imaging.scan_phase.readout_phase_model import ReadoutPhase
from recon.imaging.scan_phase.remaining_phase import include_remaining_errors
from recon.imaging.scan_phase.searched_phase import SearchedPhase, search_phase_of
from recon.imaging.scan_phase.slow_gain import GainPart, describe_slow_gain
from recon.imaging.wild_samples import without_wild_samples
from recon.quality.dropped_samples import first_late_slice, register_slices_separately
from recon.steps.estimated_motion import EstimatedMotion
from recon.steps.preparation import PreparedRecording
from recon.steps.reconstruction import Options
from recon.steps.registration_segments import registration_segments
from scanner.motion import Motion

ESTIMATORS_WITH_READOUT_PHASE = ("tracker", "sensor", "edges")
"""Estimators whose motion is corrected by the phase error that the picture shows. ``picture`` has its phase from the
picture already; the other estimators serve for comparison, as their papers describe them."""


def correct_phase_and_drift(estimated: EstimatedMotion, options: Options) -> EstimatedMotion:
    """Remove the phase error of the readout, and the drift of the detectors if it is asked for.

    If there is a drift, the phase is estimated again, from the uncorrected motion and the intensity without the drift.
    The drift is then measured again in the intensity as recorded, at the corrected positions. Without a drift the first
    phase is kept. All this is measured without the low-pass of a slow detector, which displaces detail of different
    size by a different time; the intensity that the picture is made of has it as ``options`` want it.
    """
    recorded, estimated = estimated.prepared, replace(estimated, prepared=_without_wild(estimated))
    flicker = find_flicker(estimated.beam, estimated.prepared.intensity, estimated.grid)
    if options.intensity_drift is None:
        phased = correct_readout_phase(replace(estimated, prepared=_without_flicker(estimated, flicker)), options)
        phased = replace(phased, prepared=recorded)
        notes = [*phased.motion_notes, *(describe_flicker(flicker) or _describe_gain(phased))]
        return replace(phased, prepared=phased.prepared.for_picture(options.undo_lag), motion_notes=notes)
    phased = correct_readout_phase(estimated, options)
    drifts = _measure_drift(phased, options.intensity_drift, flicker)
    if exceeds_uncertainty(drifts):
        without_drift = replace(estimated, prepared=_without_drift(estimated.prepared, drifts))
        phased = replace(correct_readout_phase(without_drift, options), prepared=estimated.prepared)
        drifts = _measure_drift(phased, options.intensity_drift, flicker)
    prepared = _without_drift(recorded.for_picture(options.undo_lag), drifts)
    notes = [*phased.motion_notes, *describe_drift(drifts, prepared.intensity)]
    return replace(phased, prepared=prepared, intensity_drift=drifts, motion_notes=notes)


def _measure_drift(
    estimated: EstimatedMotion, kind: DriftKind, flicker: Sequence[LineBlock]
) -> Sequence[IntensityDrift | None]:
    """The drift of the detectors, with the lines of the light in it."""
    return measure_intensity_drift(estimated.beam, estimated.prepared.intensity, estimated.grid, kind, flicker)


def _without_wild(estimated: EstimatedMotion) -> PreparedRecording:
    """The recording whose intensity lacks electric pulses, which would hide the phase that the picture shows."""
    prepared = estimated.prepared
    cleaned = without_wild_samples(prepared.intensity, estimated.beam, estimated.grid)
    return replace(prepared, recording=prepared.recording.with_channel(cleaned))


def _without_flicker(estimated: EstimatedMotion, flicker: Sequence[LineBlock]) -> PreparedRecording:
    """The recording whose intensity does not flicker."""
    prepared = estimated.prepared
    return replace(prepared, recording=prepared.recording.with_channel(without_flicker(prepared.intensity, flicker)))


def _without_drift(prepared: PreparedRecording, drifts: Sequence[IntensityDrift | None]) -> PreparedRecording:
    """The recording with the drift of the detectors removed from its intensity."""
    return replace(prepared, recording=prepared.recording.with_channel(correct_drift(prepared.intensity, drifts)))


def _describe_gain(estimated: EstimatedMotion) -> list[str]:
    """The note on a slow gain; none of a stack, whose drift no option removes, as a place is at a new z each time."""
    if estimated.prepared.position_z is not None:
        return []
    gains = {id(error.gain): error.gain for error in estimated.phase_errors or [] if error.gain is not None}
    segments = registration_segments(estimated.motion, estimated.prepared.intensity)
    if len(gains) != len(segments):
        return []
    return describe_slow_gain([GainPart(*part, gain) for part, gain in zip(segments, gains.values(), strict=True)])


def wants_readout_phase(motion: Motion, options: Options) -> bool:
    """Return whether the motion is to be corrected by the phase error that the picture shows."""
    return motion.estimator in ESTIMATORS_WITH_READOUT_PHASE and not options.sense_only


def measure_picture_phase_errors(estimated: EstimatedMotion) -> list[PhaseError]:
    """Return the phase errors that forward and backward half-periods show in slices of the scan.

    Their standard errors allow for a shift that all slices have in common.
    """
    intensity, position_z = estimated.prepared.intensity, estimated.prepared.position_z
    segments = registration_segments(estimated.motion, intensity, position_z)
    errors = measure_motion_phase_errors(estimated.beam, intensity, estimated.grid, segments)
    return [error.with_common_shift() for error in errors]


def correct_readout_phase(estimated: EstimatedMotion, options: Options) -> EstimatedMotion:
    """Remove the phase error of the readout that the picture shows, and keep the phase errors that are left.

    Where the picture changes its timing at some moment, the phase counts as undetermined: dropped samples are to be
    restored first. The standard deviation of the phase includes the errors that are left.
    """
    motion = estimated.motion

    def register(corrected: Motion) -> list[PhaseError]:
        return measure_picture_phase_errors(replace(estimated, motion=corrected))

    errors = register(motion)
    if not wants_readout_phase(motion, options):
        contradictions = _find_contradictions(estimated, {})
        motion = include_contradictions(motion, contradictions)
        return replace(estimated, motion=motion, phase_errors=errors, contradictions=contradictions)
    readout_phase: Mapping[str, ReadoutPhase] = {}
    contradictions, searched, beyond = [], SearchedPhase([], ()), dict[str, Sequence[PhaseError]]()
    motion, notes = remove_detector_offsets(
        motion, lambda each: replace(estimated, motion=each).beam, estimated.prepared.intensity, estimated.grid
    )
    if motion is not estimated.motion:
        errors = register(motion)
    sensed, placed = motion, _replaced_axes(estimated.motion, motion)
    if _loses_timing(estimated, errors):
        motion = replace(motion, axes={name: widen_undetermined(axis) for name, axis in motion.axes.items()})
    else:
        one_readout = motion.estimator == "tracker" and estimated.prepared.device.readout is not None
        motion, errors, readout_phase = remove_readout_phase(motion, errors, register, one_readout)
        contradictions = _find_contradictions(replace(estimated, motion=motion), readout_phase)
        searched = _search_unmeasured(replace(estimated, motion=motion), readout_phase)
        contradicted = {each.axis for each in contradictions}
        beyond = dict.fromkeys(set(searched.refuted) - contradicted - set(readout_phase), searched.errors)
        contradicted |= set(beyond)
        undetermined = set(one_direction_axes(motion)) - set(readout_phase) - contradicted - placed
        notes += [describe_unstated_place(name, stated_event(motion, name)) for name in sorted(undetermined)]
        notes += describe_readout_phase(motion, readout_phase, contradicted | undetermined)
    clock_error = find_clock_error(sensed, motion, errors) or find_clock_error(sensed, motion, searched.errors)
    # Of few slices only their mean error was removed, so the clock error is still in the motion.
    still_in_motion = clock_error is not None and len(errors) < MIN_DRIFT_SLICES
    if clock_error is not None and still_in_motion:
        clock_error = converge_clock_error(sensed, motion, clock_error, register)
    clock = describe_clock_error(clock_error, estimated.prepared.intensity)
    settled = motion
    motion, remaining_notes = include_remaining_errors(settled, errors, beyond)
    without_readout, _ = include_remaining_errors(sensed, errors, beyond)
    if clock_error is not None and still_in_motion:
        motion = include_clock_error(motion, clock_error, set(motion.axes) - _replaced_axes(settled, motion))
    is_left = still_in_motion or bool(remaining_notes)
    without_readout = include_contradictions(without_readout, contradictions)
    return replace(
        estimated,
        motion=include_contradictions(motion, contradictions),
        phase_errors=errors,
        contradictions=contradictions,
        clock_limits=clock if is_left else (),
        readout_phase=readout_phase,
        estimator_phase_sd={name: axis.phase_sd for name, axis in without_readout.axes.items()},
        motion_notes=[*notes, *([] if is_left else clock), *remaining_notes, *estimated.motion_notes],
    )


def _replaced_axes(before: Motion, after: Motion) -> set[str]:
    """Names of the axes whose motion was replaced."""
    return {name for name, axis in after.axes.items() if axis is not before.axes[name]}


def _find_contradictions(estimated: EstimatedMotion, measured: Mapping[str, ReadoutPhase]) -> list[Contradiction]:
    """The axes whose motion the picture contradicts; those whose phase it ``measured`` agree with it."""
    if set(measured) >= set(estimated.motion.axes):
        return []
    found, _ = find_contradictions(estimated.beam, estimated.prepared.intensity)
    return [each for each in found if each.axis not in measured]


def _search_unmeasured(estimated: EstimatedMotion, measured: Mapping[str, ReadoutPhase]) -> SearchedPhase:
    """The phase errors over half a turn, of a scan with an axis whose phase the registration has not ``measured``."""
    if set(measured) >= set(estimated.motion.axes):
        return SearchedPhase([], ())
    return search_phase_of(estimated.beam, estimated.prepared.intensity)


def _loses_timing(estimated: EstimatedMotion, errors: Sequence[PhaseError]) -> bool:
    """Whether the slices of the scan are late from some time on, in a picture of all and in one picture of each.

    A slice that determines nothing counts as late. A picture of few photons determines some slices by chance.
    """
    intensity, position_z = estimated.prepared.intensity, estimated.prepared.position_z
    if first_late_slice(errors, estimated.motion) is None:
        return False
    if len(registration_segments(estimated.motion, intensity, position_z)) > 1:  # the slices do not cover the scan
        return False
    separate = register_slices_separately(estimated.beam, intensity, estimated.grid, len(errors))
    return first_late_slice(separate, estimated.motion) is not None
