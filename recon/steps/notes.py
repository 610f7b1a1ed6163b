"""Notes of a reconstruction: what a reader of the picture has to know, a line each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from recon.imaging.picture import Grid
from recon.imaging.scan_phase.doubled_frequency import describe_doubled_axes
from recon.imaging.scan_phase.phase_agreement import describe_contradictions
from recon.quality.clock_jumps import longest_segment, separate_jump
from recon.quality.defects import Defect, describe_clipped_positions, describe_held_signals
from recon.quality.detector_gaps import describe_blanked_directions, describe_detector_gaps
from recon.quality.pulsed_light import describe_pulsed_light
from recon.quality.wrapped_integers import describe_wrapped_integers
from recon.steps.intensity_notes import describe_lower_rail, describe_running_sums, describe_saturation
from recon.steps.preparation import PreparedRecording
from scanner.channel import Channel
from scanner.device import AXES
from scanner.motion import Motion
from scanner.recording import Recording
from scanner.sample_ranges import SampleRanges

MAX_FRAME_EXCESS = 1e-3
"""Relative excess of a frame over the recording up to which it is the whole recording: durations are stated rounded."""

MAX_UNLOCATED_SHARE = 0.05
"""Share of samples at an unknown angle from which a note says so; the transients at both ends of a scan are shorter."""

MAX_SCANNER_HZ = 1e5
"""Frequency above which a motion is doubted: mirrors, fibres and stages that scan light resonate below 0.1 MHz."""

MIN_SCANNER_HZ = 0.01
"""Frequency below which a motion is doubted: a raster of an atomic-force microscope takes minutes."""


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
