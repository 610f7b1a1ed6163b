"""Notes of a reconstruction: what a reader of the picture has to know, a line each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from estimation.rail import upper_rail
from recon.imaging.gridding import find_sample_pixels
from recon.imaging.picture import Grid, detector_names
from recon.imaging.saturation import COUNT_UNITS, detector_rails
from recon.imaging.scan_phase.doubled_frequency import describe_doubled_axes
from recon.imaging.scan_phase.phase_agreement import describe_contradictions
from recon.imaging.wild_samples import MAX_CHECKED_SAMPLES, find_repeated, find_wild_samples, wild_limits
from recon.quality.clock_jumps import longest_segment, separate_jump
from recon.quality.defects import Defect, describe_clipped_positions, describe_held_signals
from recon.quality.detector_gaps import describe_blanked_directions, describe_detector_gaps
from recon.quality.pulsed_light import describe_pulsed_light
from recon.quality.wrapped_integers import describe_wrapped_integers
from recon.sample_ranges import SampleRanges
from recon.steps.preparation import PreparedRecording
from scanner.channel import Channel
from scanner.device import AXES
from scanner.motion import Motion
from scanner.recording import Recording
from scanner.wording import counted, percent

MAX_FRAME_EXCESS = 1e-3
"""Relative excess of a frame over the recording up to which it is the whole recording: durations are stated rounded."""

MAX_UNLOCATED_SHARE = 0.05
"""Share of samples at an unknown angle from which a note says so; the transients at both ends of a scan are shorter."""

LOGARITHMIC_UNIT = "dB"
"""Beginning of the units of logarithms: dB, dBm, dBV."""

MIN_NEGATIVE_SHARE = 0.95
"""Share of negative samples from which a voltage is taken for that of an inverting detector. A detector that is coupled
without its mean has about a half."""

MAX_STEP_OF_FIELD = 0.1
"""Way of the beam between two samples, of the field's width, from which a note says so: ten samples from edge to edge
show no picture if each is an average over the way."""

STEP_QUANTILE = 0.9
"""Quantile of the ways that is compared: the flyback of a raster is left out."""

MAX_SCANNER_HZ = 1e5
"""Frequency above which a motion is doubted: mirrors, fibres and stages that scan light resonate below 0.1 MHz."""

MIN_SCANNER_HZ = 0.01
"""Frequency below which a motion is doubted: a raster of an atomic-force microscope takes minutes."""

MIN_RISES = 1000
"""Changes of an intensity, all in one direction, from which it is a running sum: noise alone has as many of either."""


def describe_limits(
    beam: Motion, intensity: Channel, grid: Grid, unlocated: SampleRanges, defects: Sequence[Defect] = ()
) -> list[str]:
    """What the picture does not show, a line each.

    Args:
        beam, intensity, grid, unlocated: as for :func:`recon.imaging.intensity_gridding.grid_intensity`.
        defects: of the recording.
    """
    misleading = (
        describe_wrapped_integers(intensity)
        or describe_running_sums(intensity)
        or describe_pulsed_light(beam, intensity, grid)
        or describe_blanked_directions(beam, intensity)
    )
    return [
        *describe_clipped_positions(defects, beam, intensity.size / intensity.sample_rate),
        *describe_held_signals(defects, beam),
        *(misleading or describe_doubled_axes(beam, intensity) or describe_contradictions(beam, intensity)),
        *describe_saturation(intensity),
        *describe_lower_rail(intensity),
        *describe_detector_gaps(beam, intensity, grid, unlocated),
    ]


def describe_unlocated(unlocated: SampleRanges, intensity: Channel) -> list[str]:
    """A line if many samples are not mapped because the angle of the mirror is not known when they were taken."""
    share = sum(stop - first for first, stop in unlocated) / max(intensity.size, 1)
    if share <= MAX_UNLOCATED_SHARE:
        return []
    first = intensity.start + unlocated[0][0] / intensity.sample_rate
    return [
        f"intensity: {share:.0%} of the samples, the first at {first:.4g} s, are not mapped, because the angle is not "
        "known at their times; check sample_rate and start of the channels, and the gaps of the sensors"
    ]


def describe_running_sums(intensity: Channel) -> list[str]:
    """A line for each detector whose samples only rise, or only fall: a counter that is never reset."""
    values = intensity.read(0, min(intensity.size, MAX_CHECKED_SAMPLES))
    lines = []
    for name, column in zip(_detector_names(intensity), values.reshape(len(values), -1).T, strict=True):
        steps = np.diff(column[np.isfinite(column)])
        rises, falls = int(np.sum(steps > 0.0)), int(np.sum(steps < 0.0))
        if max(rises, falls) >= MIN_RISES and min(rises, falls) == 0:
            lines.append(
                f"{name}: {'rises' if rises else 'falls'} at all of the {max(rises, falls)} samples at which it "
                "changes, so that it is a running sum (a counter or an integrator), and the picture is wrong: record "
                "the difference of successive samples"
            )
    return lines


def describe_saturation(intensity: Channel) -> list[str]:
    """A line for each detector of which many samples stand exactly at the largest value.

    Args:
        intensity: shape (n,) or (n, detectors).
    """
    rails = detector_rails(intensity)
    names = _detector_names(intensity)
    checked = min(intensity.size, MAX_CHECKED_SAMPLES)
    return [
        f"{name}: {rail[1] / checked:.2%} of the samples stand at the largest value, {rail[0]:.4g} {intensity.unit}: "
        "the detector is saturated there, the picture shows no detail, and its standard deviation is not known; "
        "lower its gain or the light"
        for name, rail in zip(names, rails, strict=True)
        if rail is not None
    ]


def describe_lower_rail(intensity: Channel) -> list[str]:
    """A line for each detector of which many samples stand exactly at the smallest value, which is not 0.

    Samples at 0 are no error: darkness of a detector that counts photons.

    Args:
        intensity: shape (n,) or (n, detectors).
    """
    values = intensity.read(0, min(intensity.size, MAX_CHECKED_SAMPLES))
    lines = []
    for name, column in zip(_detector_names(intensity), values.reshape(len(values), -1).T, strict=True):
        finite = column[np.isfinite(column)]
        rail = upper_rail(-finite) if finite.size else None
        if rail is not None and rail[0] != 0.0:
            lines.append(
                f"{name}: {rail[1] / len(values):.2%} of the samples stand at the smallest value, {-rail[0]:.4g} "
                f"{intensity.unit}: the signal is clipped there, and dark places appear too bright; change the offset "
                "or the range of the converter"
            )
    return lines


def describe_polarity(intensity: Channel) -> list[str]:
    """A line for each detector of which nearly all samples are negative; counts have ``describe_negative_counts``."""
    values = intensity.read(0, min(intensity.size, MAX_CHECKED_SAMPLES))
    if intensity.unit in COUNT_UNITS or intensity.unit.startswith(LOGARITHMIC_UNIT):
        return []
    shares = np.mean(values.reshape(len(values), -1) < 0.0, axis=0)
    return [
        f"{name}: {share:.0%} of the samples are negative: if the detector's pulses are negative, bright places appear "
        "dark; invert the channel (gain = -1)"
        for name, share in zip(_detector_names(intensity), shares, strict=True)
        if share >= MIN_NEGATIVE_SHARE
    ]


def _detector_names(intensity: Channel) -> list[str]:
    """Name of each detector in messages."""
    return detector_names(intensity.detectors, intensity.shape[1] if len(intensity.shape) == 2 else 1)


def describe_intensity(beam: Motion, intensity: Channel, grid: Grid) -> list[str]:
    """Lines on the values of an intensity that are doubtful.

    Args:
        beam: motion whose angles are on the intensity's clock.
        intensity: shape (n,) or (n, detectors).
        grid: the pixels.
    """
    return [
        *describe_infinite(intensity),
        *describe_wild_samples(intensity, beam, grid),
        *describe_negative_counts(intensity),
        *describe_polarity(intensity),
        *describe_logarithms(intensity),
    ]


def describe_infinite(intensity: Channel) -> list[str]:
    """A line for infinite samples, which are those of the most light where a type of small range made them."""
    infinite = np.isinf(intensity.read(0, min(intensity.size, MAX_CHECKED_SAMPLES)))
    if not infinite.any():
        return []
    return [
        f"intensity: {percent(infinite.mean())} of the samples are infinite and left out: if they were too large for "
        "their type (float16 ends at 65504), bright places are too dark; store them in another type"
    ]


def describe_wild_samples(intensity: Channel, beam: Motion | None = None, grid: Grid | None = None) -> list[str]:
    """A line for each detector with single samples far from all others; bright points of the scene are none.

    Args:
        intensity: shape (n,) or (n, detectors).
        beam: motion whose angles are on the intensity's clock, grid: the pixels; None where the places of the samples
            are unknown.
    """
    values = intensity.read(0, min(intensity.size, MAX_CHECKED_SAMPLES))
    limits = wild_limits(values)
    wild = find_wild_samples(values, limits)
    if beam is not None and grid is not None and wild.any():
        x, y = (beam.axes[axis].angle.read(0, len(values)) for axis in AXES)
        wild &= ~find_repeated(values, limits, find_sample_pixels(x, y, grid), (grid.height, grid.width))
    lines = []
    for name, column, own in zip(_detector_names(intensity), values.reshape(len(values), -1).T, wild.T, strict=True):
        if own.any():
            number, share = counted(int(own.sum()), "single sample"), percent(float(own.mean()))
            farthest = column[own][np.argmax(np.abs(column[own] - np.nanmedian(column)))]
            lines.append(
                f"{name}: {number} ({share}) far from all others, "
                f"the farthest {farthest:.4g} {intensity.unit} (median {np.nanmedian(column):.4g}): electric pulses or "
                "errors of a transfer, which make their pixels wrong; replace them by NaN"
            )
    return lines


def describe_logarithms(intensity: Channel) -> list[str]:
    """A line for an intensity in decibels, whose means are no means of the light."""
    if not intensity.unit.startswith(LOGARITHMIC_UNIT):
        return []
    return [
        f"intensity: is in {intensity.unit}, and a pixel is the mean of logarithms, in which noise makes dark places "
        "darker: convert the samples to a linear unit first"
    ]


def describe_negative_counts(intensity: Channel) -> list[str]:
    """A line if samples of an intensity in counts or photons are negative."""
    values = intensity.read(0, min(intensity.size, MAX_CHECKED_SAMPLES))
    if intensity.unit not in COUNT_UNITS or not (values < 0.0).any():
        return []
    share = percent(float(np.mean(values < 0.0)))
    return [
        f"intensity: {share} of the samples are negative, down to {np.nanmin(values):.4g} "
        f"{intensity.unit}, which counts cannot be: check the offset and whether the integers are unsigned"
    ]


def describe_coarse_sampling(beam: Motion, intensity: Channel, grid: Grid) -> list[str]:
    """A line if the beam crosses much of the field between two samples: nothing smaller is resolved along that way."""
    steps = {}
    for axis, half_angle in zip(AXES, (grid.half_angle_x, grid.half_angle_y), strict=True):
        moved = np.abs(np.diff(beam.axes[axis].angle.read(0, min(intensity.size, MAX_CHECKED_SAMPLES))))
        moved = moved[np.isfinite(moved)]
        steps[axis] = float(np.quantile(moved, STEP_QUANTILE)) / (2.0 * half_angle) if moved.size else 0.0
    coarse = [f"{step:.0%} of the field in {axis}" for axis, step in steps.items() if step > MAX_STEP_OF_FIELD]
    if not coarse:
        return []
    return [
        f"intensity: at {intensity.sample_rate:.6g} Hz the beam moves by {' and '.join(coarse)} from one sample to the "
        "next: if the detector averages over that time, the picture shows nothing smaller; record at a higher rate"
    ]


def describe_long_frames(frame_time: float | None, intensity: Channel) -> list[str]:
    """A line if one frame of ``frame_time`` [s] is longer than the intensity, so that the film has one short frame."""
    duration = intensity.size / intensity.sample_rate
    if frame_time is None or frame_time <= duration * (1.0 + MAX_FRAME_EXCESS):
        return []
    return [
        f"--frame-time: {frame_time:.4g} s is longer than the intensity, {duration:.4g} s: the film has one frame; "
        "give a shorter time"
    ]


def describe_motion(motion: Motion, intensity: Channel) -> list[str]:
    """Lines on a motion that is doubtful or not fully determined."""
    lines = [*describe_unknown_frequencies(motion), *describe_fast_axes(motion, intensity)]
    return [*lines, *describe_ambiguous_signs(motion)]


def describe_unknown_frequencies(motion: Motion) -> list[str]:
    """A line for each axis whose signal shows no frequency."""
    return [
        f"the frequency of {name} is not determined: its signal does not repeat within the recording. The picture does "
        f"not need it; the phase of {name} has no meaning"
        for name, axis in motion.axes.items()
        if axis.reference == "blocks"
    ]


def describe_ambiguous_signs(motion: Motion) -> list[str]:
    """A line for each axis of which the recording does not determine the sign."""
    return [
        f"the sign of {axis} is ambiguous: the picture may be mirrored; --flip-{axis} turns it"
        for axis in AXES
        if motion.axes[axis].sign == "ambiguous"
    ]


def describe_fast_axes(motion: Motion, intensity: Channel) -> list[str]:
    """A line for each axis that moves faster or slower than scanners do, as where the unit of time is wrong."""
    return [
        f"{name} moves at {frequency:.4g} Hz, and mirrors, fibres and stages move at {MIN_SCANNER_HZ:g} to "
        f"{MAX_SCANNER_HZ:.0e} Hz: check the unit of time and sample_rate, {intensity.sample_rate:.4g} Hz"
        for name, frequency in (
            (name, float(np.median(axis.frequency))) for name, axis in motion.axes.items() if axis.reference != "blocks"
        )
        if not MIN_SCANNER_HZ < frequency < MAX_SCANNER_HZ
    ]


def describe_clock_jumps(recording: Recording, prepared: PreparedRecording) -> str:
    """The note on a recording of which only a segment between clock jumps is used."""
    begin, end = longest_segment(recording, prepared.clock_jumps)
    separate = separate_jump(prepared.clock_jumps)
    if separate is not None:
        return (
            f"the phase of {separate.channel} jumps at {separate.start:.6g} s and that of its drive does not, as if "
            f"{separate.channel} alone lost samples: later it is not on the clock of the other channels, and the "
            f"segment from {begin:.6g} s to {end:.6g} s is used; to use the rest, cut it and state start of "
            f"{separate.channel}"
        )
    return (
        f"a phase jumps as if samples were lost: the longest segment between such jumps is used, {begin:.6g} s to "
        f"{end:.6g} s; cut the recording at the jumps to reconstruct the rest"
    )


def describe_live_frames(live: Mapping[str, Any] | None) -> list[str]:
    """A line for each reason why frames were left out.

    Args:
        live: summary of ``--follow``; None without.
    """
    if not live:
        return []
    notes, total = [], live["frames"] + live["dropped"]
    if live["recorded_before"]:
        notes.append(
            f"live frames left out: {live['recorded_before']} of {total} were complete when the recording was opened; "
            "without --follow, --frame-time makes a film of all"
        )
    if live["overtaken"]:
        notes.append(
            f"live frames left out: {live['overtaken']} of {total}, because newer ones had arrived before they could "
            f"be reconstructed: the machine is too slow for frames of {1e3 * live['frame_s']:.4g} ms; ask for longer "
            "frames (--frame-time), fewer pixels or --picture mean"
        )
    return notes
