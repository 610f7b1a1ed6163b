"""One-to-two internal resonance: the mirror drives a mode at twice its frequency with θ², the mode acts back as q θ."""

from __future__ import annotations

import numpy as np
from numba import njit

from scanner.integrator.abi import TORQUE_LAW
from scanner.terms.term import MIN_MODE_QUALITY, Parameter, Term


@njit(TORQUE_LAW, cache=True)
def torque(t, theta, omega, other, volt, z0, z1, p, nominal):  # type: ignore[no-untyped-def]
    g, f2, q2 = p[0], p[1], p[2]
    w2 = 2.0 * np.pi * f2
    return -g * nominal.k * theta * z0, z1, w2 * w2 * (-theta * theta - z0) - w2 / q2 * z1


TERM = Term(
    effect="overtone-coupling",
    stage="mechanics",
    equation="J θ'' + b θ' + k θ (1 + g q) = τ,  q'' + (ω2/Q2) q' + ω2² q = −ω2² θ²",
    parameters=(
        Parameter("g", "1/rad^2", lambda s: 0.02 / s.amplitude**2, sign=1),
        Parameter(
            "f2",
            "Hz",
            lambda s: s.rate / np.pi,
            kind="log",
            spread=0.3,
            starts=(-0.4, -0.2, -0.1, 0.0, 0.1, 0.2, 0.4),
        ),
        Parameter("Q2", "1", lambda s: 100.0, kind="log", minimum=MIN_MODE_QUALITY),
    ),
    hidden_state_scales=(lambda s: s.amplitude**2, lambda s: 2.0 * s.rate * s.amplitude**2),
    source="Antonio, Zanette & López, Nat. Commun. 3, 806 (2012)",
    confounders={"cubic-damping": "cubic damping has no sidebands: record at several amplitudes"},
    # An internal resonance needs a motion near the resonance of the axis.
    applies=lambda axis, scales: 0.5 < scales.rate * np.sqrt(scales.J / scales.k) < 2.0,
    torque=torque,
)
