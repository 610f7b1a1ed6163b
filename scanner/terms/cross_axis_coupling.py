"""Frame and suspension let the other axis pull at this one."""

from __future__ import annotations

from numba import njit

from scanner.terms.term import Parameter, Term
from scanner.trajectory import TORQUE


@njit(TORQUE, cache=True)
def torque(t, theta, omega, other, volt, z0, z1, p, nominal):  # type: ignore[no-untyped-def]
    return -p[0] * other, 0.0, 0.0


TERM = Term(
    effect="cross-axis-coupling",
    stage="mechanics",
    equation="J θ'' + b θ' + k θ + κ θ_other = τ",
    parameters=(Parameter("kappa", "N m/rad", lambda s: 0.01 * s.k),),
    source="Urey, Wine & Osborn, Proc. SPIE 4178, 176 (2000)",
    lookalikes={"second-mode": "its frequency is not the other axis's: record the other axis"},
    applies=lambda axis, scales: scales.two_axes,
    torque=torque,
    coupled=True,
)
