"""Channels whose clocks do not run at one rate."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scanner.terms.term import Parameter, Term

Array = NDArray[np.float64]


def clock(time: Array, p: Sequence[float]) -> Array:
    return (1.0 + p[0]) * time


TERM = Term(
    effect="clock-skew",
    stage="timing",
    equation="y(t) = y_nominal((1 + ε) t)",
    parameters=(Parameter("skew", "1", lambda s: 5e-5),),
    source="IEEE 1588: drift of free-running oscillators, 1 to 200 ppm",
    lookalikes={"resonance-drift": "it moves the amplitude as well: drive the mirror, or record the angle"},
    channels=("sense", "angle"),
    clock=clock,
)
