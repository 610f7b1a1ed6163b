"""A pendulum: gravity pulls with the sine of the angle."""

from __future__ import annotations

import numpy as np
from numba import njit

from scanner.integrator.abi import TORQUE_LAW
from scanner.terms.term import Parameter, Term

MIN_AMPLITUDE_RAD = 0.3
"""Smallest amplitude at which sine and angle differ by more than 1 %: below it nothing distinguishes the law from a
cubic."""


@njit(TORQUE_LAW, cache=True)
def torque(t, theta, omega, other, volt, z0, z1, p, nominal):  # type: ignore[no-untyped-def]
    return -p[0] * (np.sin(theta) - theta), 0.0, 0.0


TERM = Term(
    effect="gravity-stiffness",
    stage="mechanics",
    equation="J θ'' + b θ' + k θ + k_g (sin θ − θ) = τ",
    parameters=(Parameter("k_g", "N m/rad", lambda s: s.k, sign=1),),
    source="Nayfeh & Mook, Nonlinear Oscillations, 1979, section 2.1",
    confounders={"cubic-stiffness": "equal up to θ⁵: record a second, larger amplitude"},
    torque=torque,
    applies=lambda axis, scales: scales.amplitude > MIN_AMPLITUDE_RAD,
)
