"""A sample that creeps under the scan."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scanner.terms.term import Parameter, Term, View

Array = NDArray[np.float64]


def output(signal: Array, p: Sequence[float], view: View) -> Array:
    return signal - p[0] * view.time


TERM = Term(
    effect="sample-motion",
    stage="optics",
    equation="s = θ - v t",
    parameters=(Parameter("v", "rad/s", lambda s: 0.03 * s.amplitude / s.duration),),
    source="uniform motion of the sample, told as the mirror's angle that would follow it",
    lookalikes={
        "resonance-drift": "a phase that drifts moves forward and backward sweeps apart, a sample moves both alike"
    },
    channels=("place",),
    output=output,
)
