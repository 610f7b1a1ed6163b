"""Frame and suspension transmit the motion of the other axis to this one."""

from __future__ import annotations

from numba import njit

from scanner.integrator.abi import TORQUE_LAW
from scanner.terms.term import Parameter, Term


@njit(TORQUE_LAW, cache=True)
def torque(t, theta, omega, other, volt, z0, z1, p, nominal):  # type: ignore[no-untyped-def]
    kappa = p[0]
    return -kappa * other, 0.0, 0.0


TERM = Term(
    effect="cross-axis-coupling",
    stage="mechanics",
    equation="J θ'' + b θ' + k θ + κ θ_other = τ",
    parameters=(Parameter("kappa", "N m/rad", lambda s: 0.01 * s.k),),
    source="Urey, Wine & Osborn, Proc. SPIE 4178, 176 (2000)",
    confounders={
        "second-mode": "a mode has its own frequency, not that of the other axis: record the other axis",
        "sensor-crosstalk": "crosstalk of the sensor has no resonance: drive the other axis at this one's resonance",
    },
    applies=lambda axis, scales: scales.two_axes,
    torque=torque,
    coupled=True,
)
