"""A reference detector that bends: arctangent or cubic."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scanner.terms.term import Parameter, Term, View

Array = NDArray[np.float64]


def output(signal: Array, p: Sequence[float], view: View) -> Array:
    return signal * (1.0 + p[0] * signal * signal)


TERM = Term(
    effect="angle-nonlinearity",
    stage="optics",
    equation="θ_ref = θ (1 + c3 θ²)",
    parameters=(Parameter("c3", "1/rad^2", lambda s: 0.03 / s.amplitude**2),),
    source="chen2019, eq. 10: θ = arctan(y G/L)",
    lookalikes={"cubic-stiffness": "sense and angle both show it: compare them"},
    channels=("angle",),
    output=output,
)
