"""A spring that is harder on one side than on the other."""

from __future__ import annotations

from numba import njit

from scanner.terms.term import Parameter, Term
from scanner.trajectory import TORQUE


@njit(TORQUE, cache=True)
def torque(t, theta, omega, other, volt, z0, z1, p, nominal):  # type: ignore[no-untyped-def]
    return -p[0] * theta * theta, 0.0, 0.0


TERM = Term(
    effect="quadratic-stiffness",
    stage="mechanics",
    equation="J θ'' + b θ' + k θ + k2 θ² = τ",
    parameters=(Parameter("k2", "N m/rad^2", lambda s: 0.1 * s.k / s.amplitude),),
    source="Nayfeh & Mook, Nonlinear Oscillations, 1979, section 4.1",
    lookalikes={
        "comb-offset": "it shows in the sense signal alone: record the angle",
        "cubic-stiffness": "no even harmonics there: record the angle",
    },
    torque=torque,
)
