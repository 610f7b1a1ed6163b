"""A spring that hardens or softens with the square of the angle (Duffing)."""

from __future__ import annotations

from numba import njit

from scanner.integrator.abi import TORQUE_LAW
from scanner.terms.term import Parameter, Term


@njit(TORQUE_LAW, cache=True)
def torque(t, theta, omega, other, volt, z0, z1, p, nominal):  # type: ignore[no-untyped-def]
    k3 = p[0]
    return -k3 * theta**3, 0.0, 0.0


TERM = Term(
    effect="cubic-stiffness",
    stage="mechanics",
    equation="J θ'' + b θ' + k θ + k3 θ³ = τ",
    parameters=(Parameter("k3", "N m/rad^3", lambda s: 0.05 * s.k / s.amplitude**2),),
    source="Nayfeh & Mook, Nonlinear Oscillations, 1979, section 4.1",
    confounders={
        "resonance-drift": "a drift follows time, cubic stiffness follows amplitude: record a second amplitude",
        "quintic-stiffness": "quintic stiffness changes the frequency with A⁴: record a second, larger amplitude",
        "sensor-cubic": "the sensor's third harmonic does not depend on frequency: drive at a second frequency",
    },
    torque=torque,
)
