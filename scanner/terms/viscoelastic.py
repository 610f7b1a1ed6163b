"""A standard linear solid: part of the stiffness relaxes."""

from __future__ import annotations

from numba import njit

from scanner.integrator.abi import TORQUE_LAW
from scanner.terms.term import Parameter, Term


@njit(TORQUE_LAW, cache=True)
def torque(t, theta, omega, other, volt, z0, z1, p, nominal):  # type: ignore[no-untyped-def]
    k_v, tau_v = p[0], p[1]
    return -k_v * (theta - z0), (theta - z0) / tau_v, 0.0


TERM = Term(
    effect="viscoelastic",
    stage="mechanics",
    equation="J θ'' + b θ' + k θ + k_v (θ − z) = τ,  z' = (θ − z)/τ_v",
    parameters=(
        Parameter("k_v", "N m/rad", lambda s: 0.08 * s.k, sign=1),
        Parameter("tau_v", "s", lambda s: 2.0 / s.rate, kind="log", spread=1.5, starts=(-1.0, 0.0, 1.0)),
    ),
    hidden_state_scales=(lambda s: s.amplitude,),
    source="Christensen, Theory of Viscoelasticity, 1982, section 1.3",
    confounders={
        "second-mode": "a mode has a resonance peak: sweep the drive over it",
        "drive-lag": "the two differ in phase and amplitude over frequency: add a step, or more frequencies",
    },
    torque=torque,
)
