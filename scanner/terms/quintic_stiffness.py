"""A spring with a fifth-order term, which matters at large angles."""

from __future__ import annotations

from numba import njit

from scanner.integrator.abi import TORQUE_LAW
from scanner.terms.term import Parameter, Term


@njit(TORQUE_LAW, cache=True)
def torque(t, theta, omega, other, volt, z0, z1, p, nominal):  # type: ignore[no-untyped-def]
    k5 = p[0]
    return -k5 * theta**5, 0.0, 0.0


TERM = Term(
    effect="quintic-stiffness",
    stage="mechanics",
    equation="J θ'' + b θ' + k θ + k5 θ⁵ = τ",
    parameters=(Parameter("k5", "N m/rad^5", lambda s: 0.03 * s.k / s.amplitude**4),),
    source="Nayfeh & Mook, Nonlinear Oscillations, 1979, section 4.1",
    confounders={"cubic-stiffness": "cubic stiffness changes the frequency with A²: record two amplitudes far apart"},
    torque=torque,
)
