"""A field that bends: the beam's place is not proportional to the mirror's angle."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scanner.terms.term import Parameter, Term, View

Array = NDArray[np.float64]


def output(signal: Array, p: Sequence[float], view: View) -> Array:
    return signal * (1.0 + p[0] * signal * signal)


TERM = Term(
    effect="field-distortion",
    stage="optics",
    equation="s = θ (1 + c3 θ²)",
    parameters=(Parameter("c3", "1/rad^2", lambda s: 0.02 / s.amplitude**2),),
    source="tan 2θ = 2θ (1 + 4/3 θ²) before a flat field, third order of an objective's distortion",
    lookalikes={"angle-nonlinearity": "a straight line on the sample bends by the field alone"},
    channels=("place",),
    output=output,
)
