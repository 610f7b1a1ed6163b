"""Drag of a mirror that stirs up the air: force with the square of the speed."""

from __future__ import annotations

from numba import njit

from scanner.terms.term import Parameter, Term
from scanner.trajectory import TORQUE


@njit(TORQUE, cache=True)
def torque(t, theta, omega, other, volt, z0, z1, p, nominal):  # type: ignore[no-untyped-def]
    return -p[0] * abs(omega) * omega, 0.0, 0.0


TERM = Term(
    effect="quadratic-drag",
    stage="mechanics",
    equation="J θ'' + b θ' + b2 |θ'|θ' + k θ = τ",
    parameters=(Parameter("b2", "N m s^2", lambda s: s.b / (s.amplitude * s.rate), sign=1),),
    source="Nayfeh & Mook, Nonlinear Oscillations, 1979, section 3.3.3",
    lookalikes={
        "cubic-damping": "decay rate follows A² there, A here: record two decades of amplitude, or the angle",
        "coulomb-friction": "decay rate follows 1/A there: record the end of the decay",
    },
    torque=torque,
)
