"""An amplifier that follows its input as a first-order section."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scanner.terms.term import Parameter, Term, View, section
from scanner.trajectory import halves, thirds

Array = NDArray[np.float64]


def voltage(voltage: Array, p: Sequence[float], view: View) -> Array:
    return thirds(section(halves(voltage), p[0], 0.5 * view.step))


TERM = Term(
    effect="drive-lag",
    stage="drive",
    equation="V' = 2π f_c (V_set − V)",
    parameters=(Parameter("f_c", "Hz", lambda s: 5.0 * s.drive_rate / (2.0 * np.pi), kind="inverse", sign=1),),
    source="Horowitz & Hill, The Art of Electronics, section 1.7",
    lookalikes={
        "readout-lag": "for a linear axis the two commute: record the angle, or drive harder",
        "channel-delay": "a delay does not shrink the signal: drive at a second frequency, or record the angle",
    },
    applies=lambda axis, scales: scales.voltage_rms > 0,
    voltage=voltage,
)
