"""A tone that follows neither drive nor motion."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scanner.terms.term import Parameter, Term, View

Array = NDArray[np.float64]


def output(signal: Array, p: Sequence[float], view: View) -> Array:
    turn = 2.0 * np.pi * p[2] * view.time
    return signal + p[0] * np.cos(turn) + p[1] * np.sin(turn)


TERM = Term(
    effect="interference",
    stage="readout",
    equation="y = y_nominal + a cos 2π f t + b sin 2π f t",
    parameters=(
        Parameter("a", "V", lambda s: 0.05 * s.sense_rms),
        Parameter("b", "V", lambda s: 0.05 * s.sense_rms),
        Parameter("f", "Hz", lambda s: s.line or 1.0, kind="line"),
    ),
    source="Ott, Electromagnetic Compatibility Engineering, 2009, chapter 2",
    lookalikes={"offset-drift": "no line: record longer"},
    applies=lambda axis, scales: scales.line is not None,
    output=output,
)
