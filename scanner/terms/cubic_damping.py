"""Damping that grows with the square of the angle (van der Pol)."""

from __future__ import annotations

from numba import njit

from scanner.integrator.abi import TORQUE_LAW
from scanner.terms.term import Parameter, Term


@njit(TORQUE_LAW, cache=True)
def torque(t, theta, omega, other, volt, z0, z1, p, nominal):  # type: ignore[no-untyped-def]
    b3 = p[0]
    return -b3 * theta * theta * omega, 0.0, 0.0


TERM = Term(
    effect="cubic-damping",
    stage="mechanics",
    equation="J θ'' + b θ' + b3 θ²θ' + k θ = τ",
    parameters=(Parameter("b3", "N m s/rad^2", lambda s: 3.0 * s.b / s.amplitude**2, sign=1),),
    source="Zaitsev, Shtempluck, Buks & Gottlieb, Nonlinear Dyn. 67, 859 (2012)",
    confounders={
        "quadratic-drag": "drag decays as A, cubic damping as A²: record two decades of amplitude, or the angle",
        "coulomb-friction": "friction decays in proportion to 1/A: record the end of the decay",
    },
    torque=torque,
)
