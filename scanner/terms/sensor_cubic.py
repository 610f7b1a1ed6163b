"""A sensor whose gain depends on its own signal."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scanner.terms.term import Parameter, Term, View

Array = NDArray[np.float64]


def output(signal: Array, p: Sequence[float], view: View) -> Array:
    return signal * (1.0 + p[0] * signal * signal)


TERM = Term(
    effect="sensor-cubic",
    stage="readout",
    equation="y = y_nominal (1 + c3 y_nominal²)",
    parameters=(Parameter("c3", "1/V^2", lambda s: 0.1 / s.sense_peak**2),),
    source="wang2019, section II: piezoresistive sensor",
    lookalikes={
        "cubic-stiffness": "the spring's third harmonic falls with the square of frequency: drive at two frequencies",
        "saturation": "flat tops in the histogram there: look at the largest samples",
    },
    output=output,
)
