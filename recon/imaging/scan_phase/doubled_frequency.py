"""Whether the picture shows that an axis moves at half the frequency that its edges were taken to state.

A detector in the centre of the swing gives an edge on the way up and one on the way down. Where all edges are taken for
crossings in one direction, the motion appears at twice its frequency: successive periods show opposite halves of the
swing in turn. At the right frequency the samples of one phase of both axes differ by noise, in any two periods. At
twice the frequency they differ more in successive periods than in periods whose numbers differ by 2.

The groups of periods may also pass slightly different places of fine detail. Therefore the direction has to agree as
well: with theta = A sin(phi) the beam is at one place at phi and pi - phi. At twice the frequency, with
theta = A sin(phi / 2), it is so at phi and -phi.
"""

from __future__ import annotations

from math import pi
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.imaging.scan_phase.detector_offset import stated_event
from recon.imaging.scan_phase.slice_matches import axis_phases
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
        if stated_event(beam, name).startswith("zero-crossing"):
            excess, sd = _excess_of_successive(beam, intensity, column)
            if _is_significant(excess, sd):
                found[name] = excess
    if not found:
        return []
    name = max(found, key=lambda each: found[each])
    frequency = float(np.median(beam.axes[name].frequency))
    return [
        f"{name}: samples of one place agree in every second period only, and differ by {np.exp(found[name]):.3g} "
        f"times their noise (squared) in successive ones, as if {name} moved at {frequency / 2:.6g} Hz in place of "
        f"{frequency:.6g} Hz, so that the picture is wrong: sync_{name} states {stated_event(beam, name)} and probably "
        f"holds the crossings in both directions; state event as both-edges"
    ]


def _excess_of_successive(beam: Motion, intensity: Channel, column: int) -> tuple[float, float]:
    """Logarithm of the ratio of squared differences, successive periods over those two apart, and its standard error.

    (0, inf) where too few cells are shared, or samples at phi and -phi agree no better than those at phi and pi - phi.
    """
    found = axis_phases(beam, intensity, 0, min(intensity.size, MAX_SAMPLES))
    if found is None:
        return 0.0, np.inf
    phases, values = found
    group = np.floor(np.unwrap(phases[column]) / (2 * pi)).astype(np.int64) % GROUPS
    for cells in CELLS:
        own, other = (np.floor(phases[k] / (2 * pi) * cells).astype(np.int64) % cells for k in (column, 1 - column))
        cell, shape = (group * cells + other) * cells + own, (GROUPS, cells, cells)
        count = np.bincount(cell, None, GROUPS * cells * cells).reshape(shape)
        total = np.bincount(cell, values - values.mean(), GROUPS * cells * cells).reshape(shape)
        same, successive = (
            np.concatenate([_squared_differences(count[a], total[a], count[b], total[b]) for a, b in pairs])
            for pairs in (SAME, SUCCESSIVE)
        )
        at = np.arange(cells)
        halved, stated = (
            _squared_differences(count, total, count[..., turned], total[..., turned])
            for turned in (cells - 1 - at, (cells // 2 - 1 - at) % cells)
        )
        if min(same.size, halved.size, stated.size) < MIN_COMMON_CELLS * len(SAME):
            continue
        excess, of_direction = _log_ratio(successive, same), _log_ratio(stated, halved)
        return excess if _is_significant(*of_direction) else (0.0, np.inf)
    return 0.0, np.inf


def _is_significant(excess: float, sd: float) -> bool:
    return excess > max(MIN_EXCESS, MIN_EXCESS_SD * sd)


def _log_ratio(a: Array, b: Array) -> tuple[float, float]:
    """Logarithm of the ratio of two means and its standard error; (0, inf) of constant samples."""
    if not (a.any() and b.any()):
        return 0.0, np.inf
    relative = [float(each.std() / each.mean()) / np.sqrt(each.size) for each in (a, b)]
    return float(np.log(a.mean() / b.mean())), float(np.hypot(*relative))


def _squared_differences(
    count_a: NDArray[Any], total_a: NDArray[Any], count_b: NDArray[Any], total_b: NDArray[Any]
) -> Array:
    """Squared differences of the means of the cells that both pictures have, in their variances for noise of 1.

    Args:
        count_a, total_a, count_b, total_b: samples and their sum in each cell, of one shape.
    """
    both = (count_a > 0) & (count_b > 0)
    n_a, n_b = count_a[both], count_b[both]
    return np.asarray(np.square(total_a[both] / n_a - total_b[both] / n_b) / (1.0 / n_a + 1.0 / n_b))
