"""A spring that is stiffer on one side than on the other."""

from __future__ import annotations

from numba import njit

from scanner.integrator.abi import TORQUE_LAW
from scanner.terms.term import Parameter, Term


@njit(TORQUE_LAW, cache=True)
def torque(t, theta, omega, other, volt, z0, z1, p, nominal):  # type: ignore[no-untyped-def]
    k2 = p[0]
    return -k2 * theta * theta, 0.0, 0.0


TERM = Term(
    effect="quadratic-stiffness",
    stage="mechanics",
    equation="J θ'' + b θ' + k θ + k2 θ² = τ",
    parameters=(Parameter("k2", "N m/rad^2", lambda s: 0.1 * s.k / s.amplitude),),
    source="Nayfeh & Mook, Nonlinear Oscillations, 1979, section 4.1",
    confounders={
        "comb-offset": "an offset shows in the sense signal only: record the angle",
        "cubic-stiffness": "cubic stiffness makes no even harmonics: record the angle",
    },
    torque=torque,
)
