"""Signs of axes that an even capacitance leaves open: as the user states, or by an angle channel or edges."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from estimation.sync.checks import check_event, check_one_direction
from estimation.sync.edge_phase import phase_from_edges
from scanner.channel import Channel
from scanner.motion import AxisMotion, Motion
from scanner.recording import Recording

SIGN_SAMPLES = 100_000
"""Samples from the start over which a motion is compared with a reference to find its sign."""


def resolve_signs(motion: Motion, recording: Recording, flips: Mapping[str, bool]) -> Motion:
    """The motion with the sign of each axis reversed where the user requests it or an angle channel shows it.

    An even capacitance does not distinguish theta from -theta.

    Args:
        flips: axes that the user reverses. An angle channel or edges decide only where the sign is ambiguous.
    """
    axes = {}
    for name, axis in motion.axes.items():
        turn, sign = flips.get(name, False), axis.sign
        if sign == "ambiguous" and f"angle_{name}" in recording and not turn:
            turn, sign = _opposes(axis, recording[f"angle_{name}"]), f"known: angle_{name}"
        elif sign == "ambiguous" and f"sync_{name}" in recording.edges and not turn:
            turn, sign = sign_from_edges(axis, recording, name)
        elif turn:
            sign = f"known: --flip-{name}"
        if turn:
            axis = axis.negated()
        axes[name] = replace(axis, sign=sign)
    return replace(motion, axes=axes)


def sign_from_edges(axis: AxisMotion, recording: Recording, name: str) -> tuple[bool, str]:
    """Whether the edges of an axis show the opposite of its motion, and the source of its sign or "ambiguous".

    Raises:
        BadInput: the edges are of both directions and state one, or the other way round.
    """
    edges = recording.edges[f"sync_{name}"]
    check_one_direction(edges)
    found = phase_from_edges(edges)
    check_event(edges, float(np.median(found.frequency)), float(np.median(axis.frequency)), f"{name} moves at")
    if found.sign == "ambiguous":
        return False, "ambiguous"
    time = axis.angle.start + np.arange(min(axis.angle.size, SIGN_SAMPLES)) / axis.angle.sample_rate
    inside = (time > found.time[0]) & (time < found.time[-1])
    phase = np.interp(time[inside], found.time, found.phase)
    return float(np.nansum(np.sin(phase) * axis.angle.read(0, time.size)[inside])) < 0.0, found.sign


def _opposes(axis: AxisMotion, angle: Channel) -> bool:
    """Whether the first samples of a motion are anticorrelated with a measured angle."""
    n = min(axis.angle.size, SIGN_SAMPLES)
    time = axis.angle.start + np.arange(n) / axis.angle.sample_rate
    m = min(angle.size, int(np.ceil((time[-1] - angle.start) * angle.sample_rate)) + 1)
    measured = np.interp(time, angle.time(0, m), angle.read(0, m))
    return float(np.nansum(measured * axis.angle.read(0, n))) < 0.0
