"""Charge that creeps into the dielectric and adds to the voltage."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scanner.terms.term import Parameter, Term, View

Array = NDArray[np.float64]


def voltage(voltage: Array, p: Sequence[float], view: View) -> Array:
    time = view.time[:-1, None] + view.step * np.array([0.0, 0.5, 1.0])
    return voltage - p[0] * np.expm1(-np.maximum(time, 0.0) / p[1])


TERM = Term(
    effect="charging",
    stage="drive",
    equation="V = V_set + V_c (1 − exp(−t/τ))",
    parameters=(
        Parameter("V_c", "V", lambda s: 1.5),
        Parameter("tau", "s", lambda s: 0.4 * s.duration, kind="log", starts=(-1.5, 0.0, 1.5)),
    ),
    source="Wibbeler, Pfeifer & Hietschold, Sens. Actuators A 71, 74 (1998)",
    lookalikes={"resonance-drift": "the drive's modulation and the current's size stay: change the bias"},
    applies=lambda axis, scales: axis.capacitance is not None and abs(scales.voltage_mean) + scales.voltage_rms > 0,
    voltage=voltage,
)
