"""An amplifier that follows its input as a first-order section."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scanner.arrays import Array
from scanner.integrator.nodes import from_nodes, to_nodes
from scanner.lowpass import apply_lowpass
from scanner.terms.term import NATURAL_PHASE_LAG, Parameter, SignalContext, Term


def voltage(voltage: Array, p: Sequence[float], context: SignalContext) -> Array:
    (f_c,) = p
    return to_nodes(apply_lowpass(from_nodes(voltage), f_c, 0.5 * context.step))


TERM = Term(
    effect="drive-lag",
    stage="drive",
    equation="V' = 2π f_c (V_set − V)",
    parameters=(
        Parameter("f_c", "Hz", lambda s: s.drive_rate / (2.0 * np.pi * NATURAL_PHASE_LAG), kind="inverse", sign=1),
    ),
    source="Horowitz & Hill, The Art of Electronics, section 1.7",
    confounders={
        "readout-lag": "for a linear axis the two commute: record the angle, or use a larger drive",
        "channel-delay": "a delay does not attenuate the signal: drive at a second frequency, or record the angle",
    },
    applies=lambda axis, scales: scales.voltage_rms > 0,
    voltage=voltage,
)
