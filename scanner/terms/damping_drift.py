"""A damping that settles to a new value while the recording runs (gas pressure, temperature)."""

from __future__ import annotations

import numpy as np
from numba import njit

from scanner.terms.term import Parameter, Term
from scanner.trajectory import TORQUE


@njit(TORQUE, cache=True)
def torque(t, theta, omega, other, volt, z0, z1, p, nominal):  # type: ignore[no-untyped-def]
    return p[0] * nominal[1] * np.expm1(-max(t, 0.0) / p[1]) * omega, 0.0, 0.0


TERM = Term(
    effect="damping-drift",
    stage="mechanics",
    equation="J θ'' + b (1 + β (1 − exp(−t/τ))) θ' + k θ = τ_drive",
    parameters=(
        Parameter("beta", "1", lambda s: 0.25),
        Parameter("tau", "s", lambda s: 0.4 * s.duration, kind="log", starts=(-1.5, 0.0, 1.5)),
    ),
    source="Newell, Science 161, 1320 (1968): damping against gas pressure",
    lookalikes={
        "gain-drift": "the angle does not follow the gain: record the angle",
        "quadratic-drag": "it follows amplitude, this follows time: record a second amplitude",
    },
    torque=torque,
)
