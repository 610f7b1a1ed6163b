"""An amplifier that gives less alternating voltage than asked for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scanner.terms.term import Parameter, Term, View

Array = NDArray[np.float64]


def voltage(voltage: Array, p: Sequence[float], view: View) -> Array:
    mean = view.raw_voltage.mean()
    return mean + p[0] * (voltage - mean)


TERM = Term(
    effect="drive-droop",
    stage="drive",
    equation="V = V̄ + g (V_set − V̄)",
    parameters=(Parameter("g", "1", lambda s: 1.0, kind="factor", spread=0.1, sign=-1),),
    source="amplifier data sheets: output swing against frequency",
    lookalikes={"inertia-scale": "it scales the static pull as well: change the bias"},
    applies=lambda axis, scales: scales.voltage_rms > 0 and scales.voltage_mean**2 > 0.01 * scales.voltage_rms**2,
    voltage=voltage,
)
