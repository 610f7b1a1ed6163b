"""Drive voltage that gets into the sense signal past the mirror."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scanner.terms.term import Parameter, Term, View

Array = NDArray[np.float64]


def output(signal: Array, p: Sequence[float], view: View) -> Array:
    change = view.raw_voltage - view.raw_voltage.mean()
    return signal + p[0] * change + p[1] * np.gradient(change, view.step) / p[2]


TERM = Term(
    effect="feedthrough",
    stage="readout",
    equation="y = y_nominal + g V + h V'/ω_d",
    parameters=(
        Parameter("g", "1", lambda s: 0.06 * s.sense_rms / s.voltage_rms),
        Parameter("h", "1", lambda s: 0.06 * s.sense_rms / s.voltage_rms),
        Parameter("omega_d", "rad/s", lambda s: s.drive_rate, kind="fixed"),
    ),
    source="Lee & Seshia, Sens. Actuators A 156, 36 (2009)",
    lookalikes={"channel-delay": "it stays when the motion stops: record two amplitudes, or a detuned drive"},
    applies=lambda axis, scales: scales.voltage_rms > 0,
    output=output,
    of_axis=True,
)
