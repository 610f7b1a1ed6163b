"""A stiffness that settles to a new value while the recording runs (warming)."""

from __future__ import annotations

import numpy as np
from numba import njit

from scanner.terms.term import Parameter, Term
from scanner.trajectory import TORQUE


@njit(TORQUE, cache=True)
def torque(t, theta, omega, other, volt, z0, z1, p, nominal):  # type: ignore[no-untyped-def]
    return p[0] * nominal[2] * np.expm1(-max(t, 0.0) / p[1]) * theta, 0.0, 0.0


TERM = Term(
    effect="resonance-drift",
    stage="mechanics",
    equation="J θ'' + b θ' + k (1 + α (1 − exp(−t/τ))) θ = τ_drive",
    parameters=(
        Parameter("alpha", "1", lambda s: 0.005),
        Parameter("tau", "s", lambda s: 0.4 * s.duration, kind="log", starts=(-1.5, 0.0, 1.5)),
    ),
    source="Hopcroft, Nix & Kenny, J. Microelectromech. Syst. 19, 229 (2010)",
    lookalikes={
        "cubic-stiffness": "it follows amplitude, this follows time: record a second amplitude",
        "charging": "the drive's modulation moves too: change the bias",
    },
    torque=torque,
)
