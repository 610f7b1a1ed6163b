"""A baseline that drifts slowly."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.polynomial.chebyshev import chebval

from scanner.arrays import Array
from scanner.terms.term import NaturalScales, Parameter, SignalContext, Term


def output(signal: Array, p: Sequence[float], context: SignalContext) -> Array:
    *coefficients, T = p
    # cos(j u) is the Chebyshev polynomial T_j of cos u, so all terms need one cosine.
    return signal + chebval(np.cos(np.pi * np.minimum(context.time / T, 1.0)), [0.0, *coefficients])


def _size(j: int) -> Callable[[NaturalScales], float]:
    return lambda s: 0.08 * s.sense_rms / j


TERM = Term(
    effect="offset-drift",
    stage="readout",
    equation="y = y_nominal + Σ c_j cos(π j t/T),  from T on as at T",
    parameters=(
        *(Parameter(f"c{j}", "V", _size(j)) for j in range(1, 6)),
        Parameter("T", "s", lambda s: s.duration, kind="fixed"),
    ),
    source="Horowitz & Hill, The Art of Electronics, section 8.1: drift and 1/f noise",
    confounders={"gain-drift": "a gain scales the harmonics too: compare the harmonics, or record the angle"},
    output=output,
    drifts=True,
)
