"""Damping that relaxes to a new value during the recording (gas pressure, temperature)."""

from __future__ import annotations

from numba import njit

from scanner.integrator.abi import TORQUE_LAW
from scanner.integrator.elementary import negative_exponential
from scanner.terms.term import Parameter, Term


@njit(TORQUE_LAW, cache=True)
def torque(t, theta, omega, other, volt, z0, z1, p, nominal):  # type: ignore[no-untyped-def]
    beta, tau = p[0], p[1]
    return beta * nominal.b * (negative_exponential(-max(t, 0.0) / tau) - 1.0) * omega, 0.0, 0.0


TERM = Term(
    effect="damping-drift",
    stage="mechanics",
    equation="J θ'' + b (1 + β (1 − exp(−t/τ))) θ' + k θ = τ_drive",
    parameters=(
        Parameter("beta", "1", lambda s: 0.25),
        Parameter("tau", "s", lambda s: 0.4 * s.duration, kind="log", starts=(-1.5, 0.0, 1.5)),
    ),
    source="Newell, Science 161, 1320 (1968): damping against gas pressure",
    confounders={
        "gain-drift": "a gain does not change the angle: record the angle",
        "quadratic-drag": "drag follows amplitude, a drift follows time: record a second amplitude",
    },
    torque=torque,
    drifts=True,
)
