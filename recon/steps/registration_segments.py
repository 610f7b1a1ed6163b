"""Segments of a scan in which the phase errors are measured by comparing forward with backward half-periods."""

from __future__ import annotations

from recon.imaging.scan_phase.bidirectional_phase import PERIODS_PER_SLICE, slow_period
from recon.steps.sign_after_rest import REST_AMPLITUDE
from recon.steps.z_rests import rest_ranges
from scanner.channel import Channel
from scanner.motion import Motion, typical_amplitude
from scanner.sample_ranges import SampleRanges, to_sample_ranges

MAX_REGISTERED_PERIODS = 200
"""Periods of the slower axis in which phase errors are measured. A scan of 60 ms has as many; in a longer recording
three parts of this total length are measured, because the cost grows with the number of samples."""


def registration_segments(motion: Motion, intensity: Channel, position_z: Channel | None = None) -> SampleRanges:
    """Return the samples (first, stop) in which phase errors are measured, each segment at one position z.

    These are all samples of a short recording, three parts of a long one, without a rest of the mirror before its start
    or after its stop: its phase is not known there. The segments of a stack lie within rests of z, because the two
    directions are compared by one picture; rests too short for a phase error are left out, unless all are too short.
    """
    to_samples = slow_period(motion) * intensity.sample_rate
    whole = round(MAX_REGISTERED_PERIODS * to_samples)
    rests = [swinging_part(motion, intensity)] if position_z is None else rest_ranges(position_z, intensity)
    rests = [(first, stop) for first, stop in rests if stop - first >= PERIODS_PER_SLICE * to_samples]
    if len(rests) < 2:
        rests = rests or [(0, intensity.size)]
        (first, stop), part = rests[0], whole // 3
        if stop - first <= whole:
            return rests
        return [(begin, begin + part) for begin in (first, first + (stop - first - part) // 2, stop - part)]
    if sum(stop - first for first, stop in rests) <= whole:
        return rests
    chosen = rests if len(rests) < 3 else [rests[0], rests[len(rests) // 2], rests[-1]]
    return [(first, min(stop, first + whole // len(chosen))) for first, stop in chosen]


def swinging_part(motion: Motion, intensity: Channel) -> tuple[int, int]:
    """The samples (first, stop) from the first to the last time at which no axis nearly rests; all if there is none."""
    first, stop = intensity.start, intensity.end
    for axis in motion.axes.values():
        swings = axis.time[axis.amplitude >= REST_AMPLITUDE * typical_amplitude(axis.amplitude)]
        if swings.size and swings[0] > axis.time[0]:
            first = max(first, float(swings[0]))
        if swings.size and swings[-1] < axis.time[-1]:
            stop = min(stop, float(swings[-1]))
    part = to_sample_ranges([(first, stop)], intensity)
    return part[0] if part else (0, intensity.size)
