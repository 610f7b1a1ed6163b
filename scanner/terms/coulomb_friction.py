"""Dry friction: a torque against the motion, independent of its speed above the one at which the contact slides."""

from __future__ import annotations

import numpy as np
from numba import njit

from scanner.integrator.abi import TORQUE_LAW
from scanner.terms.term import Parameter, Term


@njit(TORQUE_LAW, cache=True)
def torque(t, theta, omega, other, volt, z0, z1, p, nominal):  # type: ignore[no-untyped-def]
    tau_c, omega_s = p[0], p[1]
    return -tau_c * omega / np.sqrt(omega * omega + omega_s * omega_s), 0.0, 0.0


TERM = Term(
    effect="coulomb-friction",
    stage="mechanics",
    equation="J θ'' + b θ' + τ_c θ'/√(θ'² + ω_s²) + k θ = τ",
    parameters=(
        Parameter("tau_c", "N m", lambda s: 0.08 * s.b * s.amplitude * s.rate, sign=1),
        Parameter("omega_s", "rad/s", lambda s: 0.01 * s.amplitude * s.rate, kind="log"),
    ),
    source="Feeny & Liang, J. Sound Vib. 195, 149 (1996)",
    confounders={
        "quadratic-drag": "its decay rate is proportional to A, that of friction to 1/A: record the end of the decay",
        "cubic-damping": "its decay rate is proportional to A², that of friction to 1/A: record the end of the decay",
    },
    torque=torque,
)
