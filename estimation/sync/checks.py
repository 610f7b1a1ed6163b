"""Whether the edges of an axis are what they state: of this axis, and of one direction where they state one."""

from __future__ import annotations

from dataclasses import replace
from math import isclose

import numpy as np

from estimation.signals import drive_motion_frequency
from estimation.sync.edge_phase import asymmetry_is_significant, phase_from_edges
from scanner.arrays import Array
from scanner.device import Device
from scanner.edges import Edges
from scanner.errors import BadInput
from scanner.recording import Recording

MAX_FREQUENCY_DIFFERENCE = 0.05
"""Relative difference of the frequencies of edges and drive above which they are not of one motion. A decay moves at
the resonance, which a drive that excites it is nearer to."""

MIN_ALTERNATION_PERIODS = 1e-4
"""Difference of successive intervals, in periods, below which edges are evenly spaced: an angle of 0.01 degrees of the
motion. A detector is not centred as well."""

MIN_ALTERNATION_TICKS = 2.0
"""The same in steps of the clock that took the times: those of one direction alternate by up to one step where a period
is no whole number of steps."""

MIN_TICK = 1e-7
"""Least step of a clock, in intervals: smaller differences are the rounding of stored numbers."""


MAX_TICK_DEVIATION = 0.05
"""Deviation of intervals from multiples of the step, in steps, that the rounding of stored numbers may cause."""


def check_frequency(recording: Recording, device: Device, edges: Edges, name: str, frequency: float) -> None:
    """Check that an axis moves at the frequency at which its drive moves it, or else not at twice its resonance.

    Raises:
        BadInput: it does not.
    """
    driven = {axis: drive_motion_frequency(recording, device, axis) for axis in device.axes}
    expected = driven.get(name)
    if expected is None:
        if device.axis(name).mechanics is not None and edges.is_one_direction:
            check_event(edges, frequency, device.axis(name).resonance, f"the resonance of {name} in the device file is")
        return
    if isclose(frequency, expected, rel_tol=MAX_FREQUENCY_DIFFERENCE):
        return
    others = [axis for axis, other in driven.items()
              if axis != name and other and abs(frequency / other - 1.0) < MAX_FREQUENCY_DIFFERENCE]  # fmt: skip
    if not others:
        check_event(edges, frequency, expected, f"the drive moves {name} at")
    what = f"has edges of a motion at {frequency:.6g} Hz, and the drive moves {name} at {expected:.6g} Hz"
    hint = f"they fit {others[0]}: sync_x and sync_y are swapped" if others else "check event, unit and drive frequency"
    if others and edges.is_one_direction and isclose(frequency, 2.0 * expected, rel_tol=MAX_FREQUENCY_DIFFERENCE):
        hint += ", or these are the edges of both directions: then state event as both-edges"
    raise BadInput(what, file=edges.file, channel=edges.name, hint=hint)


def check_event(edges: Edges, frequency: float, expected: float, source: str) -> None:
    """Check that edges which are read as a motion at ``frequency`` do not have twice or half as many as stated.

    Args:
        frequency, expected: of the motion by the edges and by ``source`` [Hz].
        source: what knows the frequency, as the beginning of a statement that ends with it.

    Raises:
        BadInput: the frequency is twice the expected one for edges of one direction, or half of it for edges of both.
    """
    ratio, hint = (2.0, "both-edges") if edges.is_one_direction else (0.5, "zero-crossing-up or zero-crossing-down")
    if not isclose(frequency, ratio * expected, rel_tol=MAX_FREQUENCY_DIFFERENCE):
        return
    found = "twice as many edges as" if ratio > 1.0 else "half as many edges as"
    what = f"states {edges.event} and has {found} a motion at {expected:.6g} Hz gives; {source} {expected:.6g} Hz"
    hint = f"state event as {hint}" + ("" if ratio > 1.0 else ", or find the missing edges")
    raise BadInput(what, file=edges.file, channel=edges.name, hint=hint)


def check_one_direction(edges: Edges) -> None:
    """Check that edges which state one direction do not alternate between long and short intervals.

    A detector that is not exactly in the centre gives such intervals if the edges of both directions are kept.

    Raises:
        BadInput: the intervals alternate.
    """
    if not edges.is_one_direction:
        return
    try:
        found = phase_from_edges(replace(edges, event="both-edges", angle=None))
    except BadInput:  # no edges of both directions
        return
    period = found.numbered.length
    difference = float(np.median(np.abs(found.asymmetry))) * 2.0 * period / np.pi
    least = max(MIN_ALTERNATION_PERIODS * period, MIN_ALTERNATION_TICKS * _clock_step(edges.times))
    if difference < least or not asymmetry_is_significant(found.asymmetry, found.asymmetry_sd):
        return
    short, long = 0.5 * (period - difference), 0.5 * (period + difference)
    what = f"states {edges.event}, and its intervals alternate between {short:.6g} s and {long:.6g} s, as those of "
    what += "crossings in both directions"
    raise BadInput(what, file=edges.file, channel=edges.name, hint="state event as both-edges, or angle in rad")


def _clock_step(times: Array) -> float:
    """Step of the clock that took the times [s]: the least difference of two intervals, if all are multiples of it."""
    gaps = np.sort(np.diff(times))
    steps = np.diff(gaps)
    steps = steps[steps > MIN_TICK * float(np.median(gaps))]
    if not steps.size:
        return 0.0
    multiples = gaps / steps.min()
    return float(steps.min()) if np.abs(multiples - np.round(multiples)).max() < MAX_TICK_DEVIATION else 0.0
