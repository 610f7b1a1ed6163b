"""Motion of axes whose torques depend on each other's angles."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from scanner.arrays import Array
from scanner.forward_model import AxisTrajectory, DriveInput

MAX_COUPLING_ITERATIONS, COUPLING_TOLERANCE = 100, 1e-6
"""Largest number of repeated simulations of coupled axes, and the relative change of a motion that may be left out.
Away from a common resonance two repetitions suffice for a coupling of 1 %. At one, the changes are the terms of the
exponential series of pi times coupling times periods: 100 suffice for 1000 periods of 1 %."""

AxisSimulator = Callable[[str, DriveInput, tuple[float, float], "Array | None"], AxisTrajectory]
"""(axis name, drive, start, the other axis's angle at the nodes) -> the axis's motion."""


def simulate_coupled(
    drives: Mapping[str, DriveInput],
    starts: Mapping[str, tuple[float, float]],
    coupled: bool,
    simulate: AxisSimulator,
) -> dict[str, AxisTrajectory]:
    """Return the motion of every axis. Coupled axes are simulated alternately until the coupling has converged.

    The next change is at most the last one times its ratio to the one before, because the changes fall ever faster.
    Angles are NaN where the coupling does not converge.

    Args:
        drives: by axis name.
        starts: angle [rad] and rate [rad/s] at the first sample, by axis name.
        coupled: whether the torque of a term depends on the angle of the other axis.
        simulate: simulates one axis.
    """
    motions = {name: simulate(name, drives[name], starts[name], None) for name in drives}
    if coupled and len(motions) > 1:
        before = 1.0
        for _ in range(MAX_COUPLING_ITERATIONS):
            change = 0.0
            for name in drives:
                (other,) = (motion for other_name, motion in motions.items() if other_name != name)
                repeated = simulate(name, drives[name], starts[name], _angle_at_nodes(other))
                change = max(change, _relative_change(motions[name].angle, repeated.angle))
                motions[name] = repeated
            if not change * change / before > COUPLING_TOLERANCE:
                break
            before = change
        else:
            motions = {name: replace(each, angle=np.full_like(each.angle, np.nan)) for name, each in motions.items()}
    return beside_each_other(motions)


def _relative_change(before: Array, after: Array) -> float:
    """Largest change of a motion over its largest angle; NaN if it diverges."""
    return float(np.abs(after - before).max() / max(float(np.abs(after).max()), 1e-300))


def beside_each_other(motions: Mapping[str, AxisTrajectory]) -> dict[str, AxisTrajectory]:
    """Return the motions, by axis name, each with that of the other axis as ``other``."""
    return {
        name: replace(motion, other=next((each for other, each in motions.items() if other != name), None))
        for name, motion in motions.items()
    }


def _angle_at_nodes(motion: AxisTrajectory) -> Array:
    """Angle at the nodes of every step, by cubic Hermite interpolation, shape (n, 3) [rad]."""
    a, b = motion.angle[:-1], motion.angle[1:]
    middle = 0.5 * (a + b) + motion.drive.step / 8.0 * (motion.rate[:-1] - motion.rate[1:])
    return np.stack([a, middle, b], axis=1)
