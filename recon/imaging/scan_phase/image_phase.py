"""Phases measured in the picture: forward against backward half-periods correct the motion until it converges.

Grid the intensity with the current motion, measure the remaining phase error in each time slice
(``bidirectional_phase``: least squares over all samples of one place), give phase plus error to the smoother as
measurements, and repeat. Each round replaces the measurements by those around the improved motion, so no measurement
counts twice. A slice that the improved picture does not determine keeps the measurement of the round before: without
it the motion would drift away, the next picture would determine the slice again, and the rounds would alternate. The
derivation is in docs/explanation/image_phase.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from estimation.frequency_motion import frequency_motion, is_motion_computable
from estimation.optics.correction import beam_motion
from estimation.signals import drive_phase_change
from estimation.signs import resolve_signs
from estimation.term_compensation import estimate_with_terms
from estimation.tracker import PhaseMeasurement, track
from estimation.tracker.drive_only import track_drive_only
from recon.imaging.picture import Grid
from recon.imaging.scan_phase.bidirectional_phase import PERIODS_PER_SLICE, measure_motion_phase_errors, slow_period
from recon.imaging.scan_phase.frequency_phase import PERIODS_PER_PICTURE, phases_from_picture
from recon.imaging.scan_phase.phase_error import PhaseError
from recon.imaging.scan_phase.phase_search import cut_slices
from recon.imaging.scan_phase.response_phase import check_response
from scanner.arrays import Array
from scanner.channel import Channel
from scanner.device import AXES, Device
from scanner.errors import BadInput
from scanner.motion import AxisMotion, Motion, rms_phase
from scanner.recording import Recording

MAX_ROUNDS = 6
"""Rounds after which the iteration ends. Two or three are usual."""

CONVERGENCE_RATIO = 0.5
"""Change of a phase, relative to its smallest standard deviation, below which it has converged."""

MAX_PHASE_ERROR_PX = 0.1
"""Displacement by the phase's standard deviation, at the middle of a line, up to which an axis is not refined."""

MIN_RELATIVE_AMPLITUDE = 0.5
"""Amplitude of the middle block of a slice, relative to the root mean square of the slice, below which no phase is
measured. The picture shows the mean error with the squared amplitude as weight, to which such a block adds little; and
where an amplitude vanishes, the phase can turn by half a cycle within the slice."""

MAX_DISAGREEMENT_SIGMA = 3.0
"""Disagreement of the motion from drive and picture with the sensed one from which its device is wrong, for example by
a coupled mode, and its standard deviations are."""

Smoother = Callable[[Recording, Device, Mapping[str, PhaseMeasurement]], Motion]
"""Computes the motion from a recording, its device and the measured phases of each axis."""


def refine_motion(
    recording: Recording, device: Device, motion: Motion, intensity: Channel, grid: Grid, flips: Mapping[str, bool]
) -> tuple[Motion, list[str]]:
    """Refine a motion with the phases that the picture shows.

    Axes whose sense signal determines the phase to ``MAX_PHASE_ERROR_PX`` are not changed, nor are motions of other
    estimators than ``tracker`` and ``picture``. Otherwise the phases from the picture are smoothed together with the
    sense signal, or without it if drive and picture alone give the smaller phase error.

    Args:
        recording: with its intensity corrected for the optics.
        device: of the recording.
        motion: result of ``estimate`` with these ``flips``.
        intensity: shape (n,) or (n, detectors).
        grid: the pixels.
        flips: axes whose sign is inverted.

    Returns:
        The motion, and a line for each refined axis on what the picture showed.
    """
    if motion.estimator == "picture" and not is_motion_computable(recording, device):
        return phases_from_picture(recording, device, motion, intensity, grid, flips)
    response_notes: list[str] = []
    if motion.estimator == "picture":
        beam = beam_motion(motion, device, recording.origin)
        response = check_response(recording, device, motion, beam, intensity, flips)
        response_notes = response.notes
        if response.contradicted and device.scan is not None:
            free = frequency_motion(recording, device)
            free, notes = phases_from_picture(recording, device, free, intensity, grid, flips)
            return free, [*response_notes, *notes]
        if response.phases:
            start = _smooth(recording, device, track_drive_only, response.phases, flips)
            motion = replace(motion, axes={**motion.axes, **{name: start.axes[name] for name in response.phases}})
    pixels = {"x": grid.width / 2, "y": grid.height / 2}
    refined = [name for name in AXES if _rms_phase_sd(motion.axes[name]) * pixels[name] > MAX_PHASE_ERROR_PX]
    if not refined or not _smoothers(motion.estimator):
        return motion, response_notes
    sensed = motion
    rounds, ended = 0, False
    smoothed_with: dict[str, str] = {}
    phases: dict[str, PhaseMeasurement] = {}
    before = motion
    while rounds < MAX_ROUNDS and not ended:
        # In the first round amplitudes are wrong too and change, so slices far apart in time share no picture.
        periods = PERIODS_PER_PICTURE if rounds else PERIODS_PER_SLICE
        windows = cut_slices(intensity, slow_period(motion) * periods)
        errors = measure_motion_phase_errors(beam_motion(motion, device, recording.origin), intensity, grid, windows)
        found = {name: _measured_phase(errors, motion.axes[name], name, flips.get(name, False)) for name in refined}
        # The first round compares each slice with a picture of its own.
        phases = {name: keep_determined(phases[name], found[name]) for name in refined} if rounds > 1 else found
        smoothed = _smooth_each_way(recording, device, motion.estimator, phases, flips)
        ways = {name: _better_smoother(smoothed, name, sensed.axes[name]) for name in refined}
        axes = {name: smoothed[ways[name]].axes[name] for name in refined}
        improved = replace(motion, axes={**motion.axes, **axes})
        ended, chosen = end_of_rounds(before, motion, improved, refined)
        smoothed_with = ways if chosen is improved else smoothed_with
        before, motion, rounds = motion, chosen, rounds + 1
    measured = {name: int(np.isfinite(phases[name].sd).sum()) for name in refined}
    info = {"rounds": rounds, "slices": len(errors), "determined": measured, "smoothed_with": smoothed_with}
    notes = [_note(name, measured[name], len(errors), smoothed_with[name] != motion.estimator) for name in refined]
    return replace(motion, info={**motion.info, "picture": info}), [*response_notes, *notes]


def _smoothers(estimator: str) -> dict[str, Smoother]:
    """Smoothers of measured phases for a motion from ``estimator``, by the name of the estimator that each is."""
    smoothers: dict[str, Smoother] = {"picture": track_drive_only}
    if estimator == "tracker":
        smoothers["tracker"] = lambda recording, device, phases: track(recording, device, phases=phases)
    return smoothers if estimator in smoothers else {}


def _smooth_each_way(
    recording: Recording,
    device: Device,
    estimator: str,
    phases: Mapping[str, PhaseMeasurement],
    flips: Mapping[str, bool],
) -> dict[str, Motion]:
    """The motion by every smoother that finds one with these phases.

    Raises:
        BadInput: that of ``estimator`` finds none.
    """
    smoothed = {}
    for way, smooth in _smoothers(estimator).items():
        try:
            smoothed[way] = _smooth(recording, device, smooth, phases, flips)
        except BadInput:  # another one: a drive that sustains no motion, or none with these phases
            if way == estimator:
                raise
    return smoothed


def _smooth(
    recording: Recording,
    device: Device,
    smooth: Smoother,
    phases: Mapping[str, PhaseMeasurement],
    flips: Mapping[str, bool],
) -> Motion:
    """Estimate as ``estimate`` does, with measured phases; the device may have terms."""

    def run(compensated: Recording, nominal: Device) -> Motion:
        referred = {
            name: phase._replace(
                phase=phase.phase - drive_phase_change(recording, compensated, device, name, phase.time)
            )
            for name, phase in phases.items()
        }
        return resolve_signs(smooth(compensated, nominal, referred), compensated, flips)

    return estimate_with_terms(recording, device, run, treats_clipping=True)


def _measured_phase(errors: list[PhaseError], axis: AxisMotion, name: str, flipped: bool) -> PhaseMeasurement:
    """The motion's phase at the block nearest to the middle of each slice, plus the error measured there."""
    middle = axis.angle.start + np.array([error.time for error in errors])
    nearest = np.clip(
        np.round(np.interp(middle, axis.time, np.arange(axis.time.size))).astype(int), 0, axis.time.size - 1
    )
    value, sd = np.array([getattr(error, name) for error in errors]).T
    phase = axis.phase[nearest] - (np.pi if flipped else 0.0)  # smoothing happens before the user's flips
    slices = np.searchsorted(0.5 * (axis.time[nearest][1:] + axis.time[nearest][:-1]), axis.time)
    power = np.bincount(slices, axis.amplitude**2, nearest.size) / np.bincount(slices, minlength=nearest.size).clip(1)
    sd = np.where(axis.amplitude[nearest] < MIN_RELATIVE_AMPLITUDE * np.sqrt(power), np.inf, sd)
    return PhaseMeasurement(axis.time[nearest], phase + value, sd)


def keep_determined(earlier: PhaseMeasurement, found: PhaseMeasurement) -> PhaseMeasurement:
    """Measurements of this round, and where they determine nothing those of the round before of the same slices."""
    if earlier.time.size != found.time.size:
        return found
    determined = np.isfinite(found.sd)
    return PhaseMeasurement(*(np.where(determined, new, old) for new, old in zip(found, earlier, strict=True)))


def end_of_rounds(before: Motion, motion: Motion, improved: Motion, names: Sequence[str]) -> tuple[bool, Motion]:
    """Whether the rounds end, and the motion to go on with.

    They end when the motion has converged. They also end when it is again that of two rounds before: each of the two is
    consistent with the measurements about the other, and the one with the smaller stated phase error is used.

    Args:
        before, motion, improved: of three consecutive rounds.
        names: of the refined axes.
    """
    if all(_has_converged(motion.axes[name], improved.axes[name]) for name in names):
        return True, improved
    if before is motion or not all(_has_converged(before.axes[name], improved.axes[name]) for name in names):
        return False, improved
    variances = [sum(_rms_phase_sd(each.axes[name]) ** 2 for name in names) for each in (motion, improved)]
    return True, motion if variances[0] < variances[1] else improved


def _better_smoother(smoothed: Mapping[str, Motion], name: str, sensed: AxisMotion) -> str:
    """The smoother for an axis: without the sense signal only if that is more precise and agrees with the signal.

    Args:
        sensed: the axis as the sense signal alone gives it.
    """
    if "tracker" not in smoothed:
        return "picture"
    if "picture" not in smoothed:
        return "tracker"
    driven = smoothed["picture"].axes[name]
    more_precise = _rms_phase_sd(driven) < _rms_phase_sd(sensed)
    return "picture" if more_precise and _disagreement(driven, sensed) < MAX_DISAGREEMENT_SIGMA else "tracker"


def _disagreement(axis: AxisMotion, other: AxisMotion) -> float:
    """Root mean square difference of two phases, whatever their signs, in standard deviations of the difference."""
    phase, sd = (np.interp(axis.time, other.time, values) for values in (other.phase, other.phase_sd))
    difference = 0.5 * np.angle(np.exp(2j * (axis.phase - phase)))
    return _rms(difference / np.hypot(axis.phase_sd, sd))


def _rms_phase_sd(axis: AxisMotion) -> float:
    """Root mean square of the phase's standard deviation [rad]."""
    return rms_phase(axis.phase_sd, axis.amplitude)


def _rms(values: Array) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def _has_converged(before: AxisMotion, after: AxisMotion) -> bool:
    """Whether a phase changed by less than ``CONVERGENCE_RATIO`` of its smallest standard deviation."""
    if before.time.size != after.time.size:  # another smoother, with other blocks
        return False
    return _rms(after.phase - before.phase) < CONVERGENCE_RATIO * float(after.phase_sd.min())


def _note(name: str, measured: int, slices: int, sense_ignored: bool) -> str:
    """The line on what the picture showed of an axis."""
    if measured == 0:
        return f"the picture shows nothing of the phase of {name}: no feature across it, or too few samples"
    note = f"the phase of {name} was measured in the picture itself, in {measured} of {slices} slices of the scan"
    return f"{note}; the sense signal is less accurate and was not used" if sense_ignored else note
