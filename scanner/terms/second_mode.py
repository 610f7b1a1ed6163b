"""Another mode of the structure, coupled to the mirror."""

from __future__ import annotations

import numpy as np
from numba import njit

from scanner.terms.term import Parameter, Term
from scanner.trajectory import TORQUE


@njit(TORQUE, cache=True)
def torque(t, theta, omega, other, volt, z0, z1, p, nominal):  # type: ignore[no-untyped-def]
    w2 = 2.0 * np.pi * p[1]
    return p[0] * nominal[2] * z0, z1, w2 * w2 * (theta - z0) - w2 / p[2] * z1


TERM = Term(
    effect="second-mode",
    stage="mechanics",
    equation="J θ'' + b θ' + k θ = τ + c k q,  q'' + (ω2/Q2) q' + ω2² q = ω2² θ",
    parameters=(
        Parameter("c", "1", lambda s: 0.01, sign=1),
        Parameter(
            "f2", "Hz", lambda s: s.rate / 6.283185307179586, kind="log", starts=tuple(0.08 * i for i in range(-17, 18))
        ),
        Parameter("Q2", "1", lambda s: 40.0, kind="log", starts=(-0.7,)),  # broad enough to be seen between two of them
    ),
    hidden=(lambda s: s.amplitude, lambda s: s.amplitude * s.rate),
    source="Den Hartog, Mechanical Vibrations, 1956, section 3.2",
    lookalikes={
        "cross-axis-coupling": "its frequency is the other axis's: record the other axis",
        "viscoelastic": "no peak of its own: sweep the drive past the peak",
    },
    torque=torque,
)
