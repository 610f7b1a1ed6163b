"""One-to-two exchange with a mode at twice the frequency: the mirror pushes it with θ², it gives back q θ."""

from __future__ import annotations

import numpy as np
from numba import njit

from scanner.terms.term import Parameter, Term
from scanner.trajectory import TORQUE


@njit(TORQUE, cache=True)
def torque(t, theta, omega, other, volt, z0, z1, p, nominal):  # type: ignore[no-untyped-def]
    w2 = 2.0 * np.pi * p[1]
    return -p[0] * nominal[2] * theta * z0, z1, w2 * w2 * (-theta * theta - z0) - w2 / p[2] * z1


TERM = Term(
    effect="overtone-coupling",
    stage="mechanics",
    equation="J θ'' + b θ' + k θ (1 + g q) = τ,  q'' + (ω2/Q2) q' + ω2² q = −ω2² θ²",
    parameters=(
        Parameter("g", "1/rad^2", lambda s: 0.02 / s.amplitude**2, sign=1),
        Parameter(
            "f2",
            "Hz",
            lambda s: s.rate / 3.141592653589793,
            kind="log",
            spread=0.3,
            starts=(-0.4, -0.2, -0.1, 0.0, 0.1, 0.2, 0.4),
        ),
        Parameter("Q2", "1", lambda s: 100.0, kind="log"),
    ),
    hidden=(lambda s: s.amplitude**2, lambda s: 2.0 * s.rate * s.amplitude**2),
    source="Antonio, Zanette & López, Nat. Commun. 3, 806 (2012)",
    lookalikes={"cubic-damping": "no sidebands and no threshold there: record above and below the threshold"},
    # An internal resonance takes a motion at the axis's own.
    applies=lambda axis, scales: 0.5 < scales.rate * np.sqrt(scales.J / scales.k) < 2.0,
    torque=torque,
)
