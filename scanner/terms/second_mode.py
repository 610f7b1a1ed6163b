"""Another mode of the structure, coupled linearly to the mirror."""

from __future__ import annotations

import numpy as np
from numba import njit

from scanner.integrator.abi import TORQUE_LAW
from scanner.terms.term import MIN_MODE_QUALITY, Parameter, Term


@njit(TORQUE_LAW, cache=True)
def torque(t, theta, omega, other, volt, z0, z1, p, nominal):  # type: ignore[no-untyped-def]
    c, f2, q2 = p[0], p[1], p[2]
    w2 = 2.0 * np.pi * f2
    return c * nominal.k * z0, z1, w2 * w2 * (theta - z0) - w2 / q2 * z1


TERM = Term(
    effect="second-mode",
    stage="mechanics",
    equation="J θ'' + b θ' + k θ = τ + c k q,  q'' + (ω2/Q2) q' + ω2² q = ω2² θ",
    parameters=(
        Parameter("c", "1", lambda s: 0.01, sign=1),
        Parameter(
            "f2", "Hz", lambda s: s.rate / (2.0 * np.pi), kind="log", starts=tuple(0.08 * i for i in range(-17, 18))
        ),
        Parameter(
            "Q2", "1", lambda s: 40.0, kind="log", starts=(-0.7,), minimum=MIN_MODE_QUALITY
        ),  # broad enough to be detected between two start values of f2
    ),
    hidden_state_scales=(lambda s: s.amplitude, lambda s: s.amplitude * s.rate),
    source="Den Hartog, Mechanical Vibrations, 1956, section 3.2",
    confounders={
        "cross-axis-coupling": "coupling has the frequency of the other axis: record the other axis",
        "viscoelastic": "relaxation has no resonance peak: sweep the drive over the peak",
    },
    torque=torque,
)
