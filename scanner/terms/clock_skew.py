"""Channels whose clocks do not run at one rate."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scanner.terms.term import Parameter, Term, View, shifted

Array = NDArray[np.float64]


def output(signal: Array, p: Sequence[float], view: View) -> Array:
    return shifted(signal, p[0] * view.time / view.step)


TERM = Term(
    effect="clock-skew",
    stage="timing",
    equation="y(t) = y_nominal((1 + ε) t)",
    parameters=(Parameter("skew", "1", lambda s: 5e-5),),
    source="IEEE 1588: drift of free-running oscillators, 1 to 200 ppm",
    lookalikes={"resonance-drift": "it moves the amplitude as well: drive the mirror, or record the angle"},
    channels=("sense", "angle"),
    output=output,
)
