"""Motion of an axis from the edges of a detector."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from estimation.reference import absolute_reference
from estimation.signals import phase_reference
from estimation.sync.checks import check_frequency, check_one_direction
from estimation.sync.edge_phase import NOMINAL_PHASE, EdgePhase, amplitude_from_edges, phase_from_edges
from estimation.sync.harmonics import MotionHarmonics, motion_harmonics
from estimation.sync.numbering import MIN_EDGES
from scanner.angle_tracks import SampledAngle
from scanner.arrays import Array
from scanner.device import AXES, Device
from scanner.edges import Edges
from scanner.errors import BadInput
from scanner.motion import UNKNOWN_PHASE_SD_RAD, AxisMotion
from scanner.recording import Recording

KNOT_PERIODS = 4.0
"""Periods between two points of the slow clock: as those of the other estimators."""

HARMONICS_SD_BY_FIELD = 0.2
"""Relative standard deviation of the harmonics where the amplitude is taken from the field: a mirror with combs that
exceeds its field by 8 % has a third harmonic that is 13 % off."""

CHUNK_SAMPLES = 1 << 18
"""Samples whose angle is computed at a time: their harmonics take 25 MB."""

MAX_BEYOND_PERIODS = 2.0
"""Periods before the first and after the last edge to which the angle is extrapolated."""


def _without_harmonics(
    edges: Edges, found: EdgePhase, amplitude: Array | None, harmonics: MotionHarmonics
) -> tuple[EdgePhase, Array | None]:
    """Phase and amplitude of the fundamental, from those of a sine through the same edges; no amplitude stays none."""
    nominal = NOMINAL_PHASE[edges.event]
    asymmetry = found.asymmetry if edges.event == "both-edges" else np.zeros(found.time.size)
    places = [phase + side * asymmetry for phase, side in zip(nominal, (1.0, -1.0), strict=False)]
    shift = harmonics.turn_shift if edges.event == "turn" else harmonics.edge_shift
    late = np.mean([shift(place) for place in places], axis=0)
    relative_sd = np.hypot(harmonics.relative_sd, HARMONICS_SD_BY_FIELD if amplitude is None else 0.0)
    sd = np.hypot(found.phase_sd, relative_sd * late)
    if amplitude is not None and edges.angle is not None:
        place = asymmetry + late
        amplitude = edges.angle / (np.sin(place) + harmonics.deviation(place))
    return replace(found, phase=found.phase + late, phase_sd=sd), amplitude


def axis_motion_from_edges(
    recording: Recording, device: Device, edges: Edges, clock: tuple[float, float, int]
) -> tuple[AxisMotion, list[str], dict[str, object]]:
    """The motion of one axis from its edges.

    Args:
        clock: sample rate [Hz], start [s] and number of samples of the angle in the result.

    Returns:
        the motion, notes on it, and facts about the edges.

    Raises:
        BadInput: as ``number_edges``, or nothing determines the amplitude.
    """
    from scipy.interpolate import CubicHermiteSpline

    rate, start, n = clock
    inside = edges.between(start, start + n / rate).times.size
    if min(inside, edges.times.size) < min(MIN_EDGES, edges.times.size):
        what = f"{inside} of its {edges.times.size} edges lie between {start:.6g} s and {start + n / rate:.6g} s, when "
        what += f"the intensity was recorded; they last from {edges.times[0]:.6g} s to {edges.times[-1]:.6g} s"
        raise BadInput(what, file=edges.file, channel=edges.name, hint="check their unit and the channels' start")
    check_one_direction(edges)
    name, found = edges.name.partition("_")[2], phase_from_edges(edges)
    check_frequency(recording, device, edges, name, float(np.median(found.frequency)))
    measured = amplitude_from_edges(edges, found)
    notes = [line for line in [found.describe(edges.name)] if line]
    if measured is None:
        if device.scan is None:
            what = "edges alone do not determine the amplitude"
            hint = "state the field of view, [scan], in the device, or the angle of a detector beside the centre"
            raise BadInput(what, file=edges.file, channel=edges.name, hint=hint)
        amplitude = np.full(found.time.size, device.scan.mechanical_half_angles[AXES.index(name)])
        notes.append(f"{edges.name}: the edges do not determine the amplitude; the motion is taken to fill the field")
        if edges.angle and edges.event == "both-edges":
            notes.append(
                f"{edges.name}: states a detector at {edges.angle:.4g} rad, and its edges are evenly spaced, as those "
                "of a detector in the centre: check angle, in rad"
            )
    else:
        amplitude = measured[0]
    step = max(1, round(KNOT_PERIODS * found.time.size * found.numbered.length / np.ptp(found.time)))
    if f"drive_{name}" in recording and device.axis(name).drive is not None:
        reference = phase_reference(recording, device, name)
    else:
        reference = absolute_reference(float(np.median(found.frequency)), *map(float, found.time[[0, -1]]))
    knots = found.time[::step]
    slow_phase = found.phase[::step] - reference.phase(knots)
    harmonics = motion_harmonics(recording, device, name, reference, knots, slow_phase, amplitude[::step])
    if harmonics is not None:
        by_edges = None if measured is None else amplitude
        found, by_edges = _without_harmonics(edges, found, by_edges, harmonics.at(knots, found.time))
        amplitude = amplitude if by_edges is None else by_edges
    if abs(edges.hysteresis) > float(np.median(amplitude)):
        what = f"hysteresis is {edges.hysteresis:g} rad, more than the amplitude, {float(np.median(amplitude)):.4g} rad"
        raise BadInput(what, file=edges.file, channel=edges.name, hint="state it in rad, as the mirror turns")
    if edges.hysteresis:
        lag = np.arcsin(np.clip(edges.hysteresis / (amplitude * np.cos(found.asymmetry)), -1.0, 1.0))
    else:
        lag = np.zeros(found.time.size)
    phase = found.phase + lag
    spline = CubicHermiteSpline(found.time, phase, 2 * np.pi * found.frequency)
    beyond, angle = MAX_BEYOND_PERIODS / float(np.median(found.frequency)), np.empty(n, np.float32)
    for first in range(0, n, CHUNK_SAMPLES):
        time = start + np.arange(first, min(first + CHUNK_SAMPLES, n)) / rate
        u = spline(time)
        relative = 0.0 if harmonics is None else harmonics.at(knots, time).deviation(u)
        values = np.interp(time, found.time, amplitude) * (np.sin(u) + relative)
        is_known = np.interp(time, found.time, found.phase_sd) < UNKNOWN_PHASE_SD_RAD
        values[~is_known | (time < found.time[0] - beyond) | (time > found.time[-1] + beyond)] = np.nan
        angle[first : first + CHUNK_SAMPLES] = values
    motion = AxisMotion(
        time=knots,
        phase=phase[::step] - reference.phase(knots),
        amplitude=amplitude[::step],
        frequency=found.frequency[::step],
        phase_sd=found.phase_sd[::step],
        angle=SampledAngle(angle, rate, start),
        reference=reference.kind,
        reference_frequency=reference.frequency,
        sign=found.sign,
        amplitude_sd=None if measured is None else measured[1][::step],
    )
    facts: dict[str, object] = {
        "event": edges.event,
        "edges": found.edges,
        "missing": found.numbered.missing,
        "repeated": found.numbered.doubled,
        "out_of_place": found.numbered.stray + found.outliers,
        "jitter_s": found.jitter_sd,
        "asymmetry_rad": float(np.median(found.asymmetry)),
        "asymmetry_sd_rad": float(np.median(found.asymmetry_sd)),
        "amplitude_sd_rad": None if measured is None else float(np.median(measured[1])),
    }
    return motion, notes, facts
