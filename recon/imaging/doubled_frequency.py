"""Whether the picture shows that an axis moves at half the frequency that its edges were taken to state.

A detector in the centre of the swing gives an edge on the way up and one on the way down. Where all edges are taken for
crossings in one direction, the motion appears at twice its frequency: successive periods show opposite halves of the
swing in turn. At the right frequency the samples of one phase of both axes differ by noise, in any two periods. At
twice the frequency they differ more in successive periods than in periods whose numbers differ by 2.
"""

from __future__ import annotations

from math import pi
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.imaging.phase_agreement import axis_phases
from scanner.arrays import Array
from scanner.channel import Channel
from scanner.device import AXES
from scanner.motion import Motion

CELLS = (64, 32)
"""Cells of a turn of either phase: the finer ones where the groups of periods pass enough of the same."""

MIN_COMMON_CELLS = 75
"""Visited cells that two groups of periods have to share in the mean."""

MAX_SAMPLES = 1 << 20
"""Samples from the start that are compared: 64 for each cell of each group. Edges state the phase at all times, so that
no shorter slices are needed."""

GROUPS = 4
"""Periods are compared by their number modulo 4."""

SAME, SUCCESSIVE = ((0, 2), (1, 3)), ((0, 1), (1, 2), (2, 3), (3, 0))
"""Pairs of groups that show the same half of the swing at twice the frequency, and pairs that show opposite halves."""

MIN_EXCESS_SD = 6.0
"""Excess of the squared differences of successive periods in its standard errors, by the scatter of the cells."""

MIN_EXCESS = 0.1
"""Relative excess from which it counts: an illumination that flickers is not to be taken for a wrong motion."""


def describe_doubled_axes(beam: Motion, intensity: Channel) -> list[str]:
    """A line for the axis whose edges of one direction the picture shows to be those of both directions.

    Only the axis with the clearest contradiction is named: its wrong places disturb the comparison of the other axis.

    Args:
        beam: motion whose angles are on the intensity's clock.
        intensity: shape (n,) or (n, detectors); detectors are averaged.
    """
    found = {}
    for column, name in enumerate(AXES):
        if _event(beam, name).startswith("zero-crossing"):
            excess, sd = _excess_of_successive(beam, intensity, column)
            if excess > max(MIN_EXCESS, MIN_EXCESS_SD * sd):
                found[name] = excess
    if not found:
        return []
    name = max(found, key=lambda each: found[each])
    frequency = float(np.median(beam.axes[name].frequency))
    return [
        f"{name}: samples of one place agree in every second period only, and differ by {np.exp(found[name]):.3g} "
        f"times their noise (squared) in successive ones, as if {name} moved at {frequency / 2:.6g} Hz in place of "
        f"{frequency:.6g} Hz, so that the picture is wrong: sync_{name} states {_event(beam, name)} and probably holds "
        f"the crossings in both directions; state event as both-edges"
    ]


def _event(beam: Motion, name: str) -> str:
    """What the edges of an axis state that an edge is; empty for an axis without edges."""
    stated = beam.info.get(f"sync_{name}")
    return str(stated.get("event", "")) if isinstance(stated, dict) else ""


def _excess_of_successive(beam: Motion, intensity: Channel, column: int) -> tuple[float, float]:
    """Logarithm of the ratio of squared differences, successive periods over those two apart, and its standard error.

    (0, inf) where too few cells are shared.
    """
    found = axis_phases(beam, intensity, 0, min(intensity.size, MAX_SAMPLES))
    if found is None:
        return 0.0, np.inf
    phases, values = found
    group = np.floor(np.unwrap(phases[column]) / (2 * pi)).astype(np.int64) % GROUPS
    for cells in CELLS:
        x, y = (np.floor(phase / (2 * pi) * cells).astype(np.int64) % cells for phase in phases)
        cell, size = (group * cells + y) * cells + x, GROUPS * cells * cells
        count = np.bincount(cell, None, size).reshape(GROUPS, -1)
        total = np.bincount(cell, values - values.mean(), size).reshape(GROUPS, -1)
        squares = [_squared_differences(count, total, pairs) for pairs in (SAME, SUCCESSIVE)]
        if squares[0].size < MIN_COMMON_CELLS * len(SAME) or not all(each.any() for each in squares):
            continue
        same, other = (float(each.mean()) for each in squares)
        relative_sds = [float(each.std() / each.mean()) / np.sqrt(each.size) for each in squares]
        return float(np.log(other / same)), float(np.hypot(*relative_sds))
    return 0.0, np.inf


def _squared_differences(count: NDArray[Any], total: NDArray[Any], pairs: tuple[tuple[int, int], ...]) -> Array:
    """Squared differences of the cells that two groups share, in their variances for noise of 1.

    Args:
        count, total: samples and their sum in each cell of each group, shape (groups, cells).
        pairs: of groups that are compared.
    """
    squares = []
    for a, b in pairs:
        both = (count[a] > 0) & (count[b] > 0)
        difference = total[a, both] / count[a, both] - total[b, both] / count[b, both]
        squares.append(np.square(difference) / (1.0 / count[a, both] + 1.0 / count[b, both]))
    return np.concatenate(squares)
