"""An amplifier whose alternating output voltage is smaller than its input."""

from __future__ import annotations

from collections.abc import Sequence

from scanner.arrays import Array
from scanner.terms.term import Parameter, SignalContext, Term


def voltage(voltage: Array, p: Sequence[float], context: SignalContext) -> Array:
    (g,) = p
    mean = context.raw_voltage.mean()
    return mean + g * (voltage - mean)


TERM = Term(
    effect="drive-droop",
    stage="drive",
    equation="V = V̄ + g (V_set − V̄)",
    parameters=(Parameter("g", "1", lambda s: 1.0, kind="factor", spread=0.1, sign=-1),),
    source="amplifier data sheets: output swing against frequency",
    confounders={"inertia-scale": "inertia scales the static torque as well: change the bias"},
    applies=lambda axis, scales: scales.voltage_rms > 0 and scales.voltage_mean**2 > 0.01 * scales.voltage_rms**2,
    voltage=voltage,
)
