"""A drift of a simulation plan as a term of the mechanics."""

from __future__ import annotations

import numpy as np
from numba import njit

from scanner.active_terms import ActiveTerm
from scanner.drift import Drift
from scanner.integrator.abi import TORQUE_LAW
from scanner.terms import Term

DRIFT_STEP_S = 2e-6
"""Spacing of the table of a drift [s]: far below the time constant of any drift, and small enough for memory."""


def drift_terms(drift: Drift, t0: float, t1: float) -> tuple[ActiveTerm, ...]:
    """Return a drift of stiffness and damping from ``t0`` to ``t1`` [s] as a term; no term where nothing drifts.

    The parameters of the term are a table, so a device file cannot state it.
    """
    knots = np.linspace(t0, t1, max(2, round((t1 - t0) / DRIFT_STEP_S) + 1))
    table = np.stack([drift.stiffness(knots) - 1.0, drift.damping(knots) - 1.0], axis=1)
    if not table.any():
        return ()
    return (ActiveTerm(_DRIFT, (t0, (t1 - t0) / (knots.size - 1), float(knots.size), *table.ravel().tolist())),)


@njit(TORQUE_LAW, cache=True)
def _drift_torque(t, theta, omega, other, volt, z0, z1, p, nominal):  # type: ignore[no-untyped-def]
    start, step, knots = p[0], p[1], int(p[2])
    position = (t - start) / step
    knot = min(max(int(position), 0), knots - 2)
    i, u = 3 + 2 * knot, position - knot
    stiffness, damping = p[i] + u * (p[i + 2] - p[i]), p[i + 1] + u * (p[i + 3] - p[i + 1])
    return -stiffness * nominal.k * theta - damping * nominal.b * omega, 0.0, 0.0


_DRIFT = Term(
    "drift", "mechanics", "J θ'' + b(t) θ' + k(t) θ = τ", (), "drift of a simulation plan", torque=_drift_torque
)
