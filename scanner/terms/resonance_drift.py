"""Stiffness that relaxes to a new value during the recording (warming)."""

from __future__ import annotations

from numba import njit

from scanner.integrator.abi import TORQUE_LAW
from scanner.integrator.elementary import negative_exponential
from scanner.terms.term import Parameter, Term


@njit(TORQUE_LAW, cache=True)
def torque(t, theta, omega, other, volt, z0, z1, p, nominal):  # type: ignore[no-untyped-def]
    alpha, tau = p[0], p[1]
    return alpha * nominal.k * (negative_exponential(-max(t, 0.0) / tau) - 1.0) * theta, 0.0, 0.0


TERM = Term(
    effect="resonance-drift",
    stage="mechanics",
    equation="J θ'' + b θ' + k (1 + α (1 − exp(−t/τ))) θ = τ_drive",
    parameters=(
        Parameter("alpha", "1", lambda s: 0.005),
        Parameter("tau", "s", lambda s: 0.4 * s.duration, kind="log", starts=(-1.5, 0.0, 1.5)),
    ),
    source="Hopcroft, Nix & Kenny, J. Microelectromech. Syst. 19, 229 (2010)",
    confounders={
        "cubic-stiffness": "cubic stiffness follows amplitude, a drift follows time: record a second amplitude",
        "charging": "charging changes the modulation by the drive too: change the bias",
    },
    torque=torque,
    drifts=True,
)
