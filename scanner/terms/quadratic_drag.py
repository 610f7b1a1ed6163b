"""Aerodynamic drag: a torque proportional to the square of the rate."""

from __future__ import annotations

from numba import njit

from scanner.integrator.abi import TORQUE_LAW
from scanner.terms.term import Parameter, Term


@njit(TORQUE_LAW, cache=True)
def torque(t, theta, omega, other, volt, z0, z1, p, nominal):  # type: ignore[no-untyped-def]
    b2 = p[0]
    return -b2 * abs(omega) * omega, 0.0, 0.0


TERM = Term(
    effect="quadratic-drag",
    stage="mechanics",
    equation="J θ'' + b θ' + b2 |θ'|θ' + k θ = τ",
    parameters=(Parameter("b2", "N m s^2", lambda s: s.b / (s.amplitude * s.rate), sign=1),),
    source="Nayfeh & Mook, Nonlinear Oscillations, 1979, section 3.3.3",
    confounders={
        "cubic-damping": "cubic damping decays as A², drag as A: record two decades of amplitude, or the angle",
        "coulomb-friction": "friction decays in proportion to 1/A: record the end of the decay",
    },
    torque=torque,
)
