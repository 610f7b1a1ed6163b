"""Two-to-one exchange with a mode at half the frequency: pumped through its stiffness, it grows above a threshold.

Both ways the coupling is the slope of one energy, k (θ q² sgn(g)/2 − s θ q): what pushes the mode pushes back.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from scanner.terms.term import Parameter, Term
from scanner.trajectory import TORQUE


@njit(TORQUE, cache=True)
def torque(t, theta, omega, other, volt, z0, z1, p, nominal):  # type: ignore[no-untyped-def]
    w2 = 2.0 * np.pi * p[1]
    swing = w2 * w2 * (abs(p[0]) * p[3] * theta - (1.0 + p[0] * theta) * z0) - w2 / p[2] * z1
    return nominal[2] * (p[3] * z0 - 0.5 * np.copysign(z0 * z0, p[0])), z1, swing


TERM = Term(
    effect="mode-coupling",
    stage="mechanics",
    equation=(
        "J θ'' + b θ' + k (θ ± q²/2 − s q) = τ,  q'' + (ω2/Q2) q' + ω2² (q + g θ q − |g| s θ) = 0,  ± the sign of g"
    ),
    parameters=(
        Parameter("g", "1/rad", lambda s: 0.08 / s.amplitude, starts=(0.4, -0.4, 1.0, -1.0, 2.0, -2.0)),
        Parameter("f2", "Hz", lambda s: s.rate / (4.0 * np.pi), kind="log", spread=0.01, starts=(-0.2, 0.0, 0.2)),
        Parameter("Q2", "1", lambda s: 80.0, kind="log", spread=0.5),
        # Next to nothing, but what grows needs something to grow from, and how much tells when it is there.
        Parameter("s", "rad^0.5", lambda s: 0.01 * s.amplitude**0.5, starts=(1.0,)),
    ),
    hidden=(lambda s: s.amplitude**0.5, lambda s: 0.5 * s.rate * s.amplitude**0.5),
    seeds=((1.0, 0.0), (0.0, 1.0), (0.2, 0.2), (0.04, 0.04), (0.008, 0.008), (0.0016, 0.0016)),
    source="Nayfeh & Mook, Nonlinear Oscillations, Wiley (1979), 6.5: internal resonance of two to one",
    lookalikes={
        "cubic-damping": "no sidebands and no threshold there: record above and below the threshold",
        "overtone-coupling": "no threshold there",
    },
    # An internal resonance takes a motion at the axis's own.
    applies=lambda axis, scales: 0.5 < scales.rate * np.sqrt(scales.J / scales.k) < 2.0,
    torque=torque,
)
