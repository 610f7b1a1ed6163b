"""Two-to-one internal resonance: a mode at half the frequency is pumped parametrically and grows above a threshold.

Both directions of the coupling follow from one potential energy, k (θ q² sgn(g)/2 − s θ q), so energy is conserved.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from scanner.integrator.abi import TORQUE_LAW
from scanner.terms.term import MIN_MODE_QUALITY, Parameter, Term


@njit(TORQUE_LAW, cache=True)
def torque(t, theta, omega, other, volt, z0, z1, p, nominal):  # type: ignore[no-untyped-def]
    g, f2, q2, s = p[0], p[1], p[2], p[3]
    w2 = 2.0 * np.pi * f2
    acceleration = w2 * w2 * (abs(g) * s * theta - (1.0 + g * theta) * z0) - w2 / q2 * z1
    return nominal.k * (s * z0 - 0.5 * np.copysign(z0 * z0, g)), z1, acceleration


TERM = Term(
    effect="mode-coupling",
    stage="mechanics",
    equation=(
        "J θ'' + b θ' + k (θ ± q²/2 − s q) = τ,  q'' + (ω2/Q2) q' + ω2² (q + g θ q − |g| s θ) = 0,  ± the sign of g"
    ),
    parameters=(
        Parameter("g", "1/rad", lambda s: 0.08 / s.amplitude, starts=(0.4, -0.4, 1.0, -1.0, 2.0, -2.0)),
        Parameter("f2", "Hz", lambda s: s.rate / (4.0 * np.pi), kind="log", spread=0.01, starts=(-0.2, 0.0, 0.2)),
        Parameter("Q2", "1", lambda s: 80.0, kind="log", spread=0.5, minimum=MIN_MODE_QUALITY),
        # Small, but the mode grows from it, and its size sets the time at which the mode has grown.
        Parameter("s", "rad^0.5", lambda s: 0.01 * s.amplitude**0.5, starts=(1.0,)),
    ),
    hidden_state_scales=(lambda s: s.amplitude**0.5, lambda s: 0.5 * s.rate * s.amplitude**0.5),
    initial_seeds=((1.0, 0.0), (0.0, 1.0), (0.2, 0.2), (0.04, 0.04), (0.008, 0.008), (0.0016, 0.0016)),
    source="Nayfeh & Mook, Nonlinear Oscillations, Wiley (1979), 6.5: internal resonance of two to one",
    confounders={
        "cubic-damping": "cubic damping has no sidebands and no threshold: record above and below the threshold",
        "overtone-coupling": "overtone coupling has no threshold: record above and below the threshold",
    },
    # An internal resonance needs a motion near the resonance of the axis.
    applies=lambda axis, scales: 0.5 < scales.rate * np.sqrt(scales.J / scales.k) < 2.0,
    torque=torque,
)
