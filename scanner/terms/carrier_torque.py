"""The readout carrier exerts a torque on the mirror: its mean square adds to that of the drive."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scanner.arrays import Array
from scanner.terms.term import Parameter, SignalContext, Term, driven_by_comb


def voltage(voltage: Array, p: Sequence[float], context: SignalContext) -> Array:
    (half_square,) = p
    return np.copysign(np.sqrt(np.maximum(voltage**2 + half_square, 0.0)), voltage)


TERM = Term(
    effect="carrier-torque",
    stage="drive",
    equation="τ = ½ C'(θ) (V² + V_c0²/2)",
    parameters=(Parameter("half_square", "V^2", lambda s: 0.02 * (s.voltage_mean**2 + s.voltage_rms**2), sign=1),),
    source="chen2020, eq. 16 with the carrier of Table II: V_c0²/2 = 18 V²",
    confounders={
        "resonance-drift": "the carrier changes the stiffness by a constant within the tolerance of k: change the bias"
    },
    applies=lambda axis, scales: driven_by_comb(axis) and scales.voltage_mean**2 + scales.voltage_rms**2 > 0,
    voltage=voltage,
    torque_only=True,
)
