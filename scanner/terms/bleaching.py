"""A sample that fades while it is looked at; a laser that dims looks the same."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scanner.terms.term import Parameter, Term, View

Array = NDArray[np.float64]


def output(signal: Array, p: Sequence[float], view: View) -> Array:
    return signal * np.exp(-view.time / p[0])


TERM = Term(
    effect="bleaching",
    stage="optics",
    equation="I(t) = L e^(-t/τ)",
    parameters=(Parameter("tau", "s", lambda s: 2.0 * s.duration, kind="inverse", sign=1),),
    source="single-exponential photobleaching of a fluorophore under constant light",
    channels=("intensity",),
    output=output,
)
