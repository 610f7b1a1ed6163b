"""Charge that accumulates in the dielectric and adds to the drive voltage."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scanner.arrays import Array
from scanner.terms.term import Parameter, SignalContext, Term, driven_by_comb


def voltage(voltage: Array, p: Sequence[float], context: SignalContext) -> Array:
    V_c, tau = p
    time = context.time[:-1, None] + context.step * np.array([0.0, 0.5, 1.0])
    return voltage - V_c * np.expm1(-np.maximum(time, 0.0) / tau)


TERM = Term(
    effect="charging",
    stage="drive",
    equation="V = V_set + V_c (1 − exp(−t/τ))",
    parameters=(
        Parameter("V_c", "V", lambda s: 1.5),
        Parameter("tau", "s", lambda s: 0.4 * s.duration, kind="log", starts=(-1.5, 0.0, 1.5)),
    ),
    source="Wibbeler, Pfeifer & Hietschold, Sens. Actuators A 71, 74 (1998)",
    confounders={"resonance-drift": "a drift leaves modulation and current unchanged: change the bias"},
    applies=lambda axis, scales: driven_by_comb(axis) and abs(scales.voltage_mean) + scales.voltage_rms > 0,
    voltage=voltage,
    drifts=True,
)
