"""The readout carrier pulls at the mirror too: its mean square adds to that of the drive."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scanner.terms.term import Parameter, Term, View

Array = NDArray[np.float64]


def voltage(voltage: Array, p: Sequence[float], view: View) -> Array:
    return np.sqrt(np.maximum(voltage**2 + p[0], 0.0))


TERM = Term(
    effect="carrier-torque",
    stage="drive",
    equation="τ = ½ C'(θ) (V² + V_c0²/2)",
    parameters=(Parameter("half_square", "V^2", lambda s: 0.02 * (s.voltage_mean**2 + s.voltage_rms**2), sign=1),),
    source="chen2020, eq. 16 with the carrier of Table II: V_c0²/2 = 18 V²",
    lookalikes={"resonance-drift": "a fixed stiffening here: k within its tolerance; change the bias"},
    applies=lambda axis, scales: axis.capacitance is not None and scales.voltage_mean**2 + scales.voltage_rms**2 > 0,
    voltage=voltage,
)
