"""A baseline that wanders."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.polynomial.chebyshev import chebval
from numpy.typing import NDArray

from scanner.terms.term import Parameter, Scales, Term, View

Array = NDArray[np.float64]


def output(signal: Array, p: Sequence[float], view: View) -> Array:
    # cos(j turn) is Chebyshev's polynomial of the cosine: one cosine for all of them.
    return signal + chebval(np.cos(np.pi * view.time / p[-1]), [0.0, *p[:-1]])


def _size(j: int) -> Callable[[Scales], float]:
    return lambda s: 0.08 * s.sense_rms / j


TERM = Term(
    effect="offset-drift",
    stage="readout",
    equation="y = y_nominal + Σ c_j cos(π j t/T)",
    parameters=(
        *(Parameter(f"c{j}", "V", _size(j)) for j in range(1, 6)),
        Parameter("T", "s", lambda s: s.duration, kind="fixed"),
    ),
    source="Horowitz & Hill, The Art of Electronics, section 8.1: drift and 1/f noise",
    lookalikes={"gain-drift": "the harmonics scale with it: look at them, or record the angle"},
    output=output,
)
