"""Drive voltage that couples into the sense signal electrically."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scanner.arrays import Array
from scanner.terms.term import Parameter, SignalContext, Term


def output(signal: Array, p: Sequence[float], context: SignalContext) -> Array:
    g, h, omega_d = p
    change = context.raw_voltage - context.raw_voltage.mean()
    return signal + g * change + h * np.gradient(change, context.step) / omega_d


TERM = Term(
    effect="feedthrough",
    stage="readout",
    equation="y = y_nominal + g (V − V̄) + h V'/ω_d",
    parameters=(
        Parameter("g", "1", lambda s: 0.06 * s.sense_rms / s.voltage_rms),
        Parameter("h", "1", lambda s: 0.06 * s.sense_rms / s.voltage_rms),
        Parameter("omega_d", "rad/s", lambda s: s.drive_rate, kind="fixed"),
    ),
    source="Lee & Seshia, Sens. Actuators A 156, 36 (2009)",
    confounders={
        "channel-delay": "feedthrough remains when the motion stops: record two amplitudes, or a detuned drive"
    },
    applies=lambda axis, scales: scales.voltage_rms > 0,
    output=output,
    per_axis=True,
)
