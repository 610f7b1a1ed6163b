"""Dry friction: a torque against the motion, whatever its speed above that at which the contact begins to slide."""

from __future__ import annotations

import numpy as np
from numba import njit

from scanner.terms.term import Parameter, Term
from scanner.trajectory import TORQUE


@njit(TORQUE, cache=True)
def torque(t, theta, omega, other, volt, z0, z1, p, nominal):  # type: ignore[no-untyped-def]
    return -p[0] * omega / np.sqrt(omega * omega + p[1] * p[1]), 0.0, 0.0


TERM = Term(
    effect="coulomb-friction",
    stage="mechanics",
    equation="J θ'' + b θ' + τ_c θ'/√(θ'² + ω_s²) + k θ = τ",
    parameters=(
        Parameter("tau_c", "N m", lambda s: 0.08 * s.b * s.amplitude * s.rate, sign=1),
        Parameter("omega_s", "rad/s", lambda s: 0.01 * s.amplitude * s.rate, kind="log"),
    ),
    source="Feeny & Liang, J. Sound Vib. 195, 149 (1996)",
    lookalikes={
        "quadratic-drag": "decay rate follows A there, 1/A here: record the end of the decay",
        "cubic-damping": "decay rate follows A² there, 1/A here: record the end of the decay",
    },
    torque=torque,
)
