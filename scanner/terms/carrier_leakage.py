"""Carrier that reaches the detector past the comb and adds as a vector."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scanner.device import Amdm
from scanner.terms.term import Parameter, Term, View

Array = NDArray[np.float64]


def output(signal: Array, p: Sequence[float], view: View) -> Array:
    return np.sqrt((signal + p[0]) ** 2 + p[1] ** 2)


TERM = Term(
    effect="carrier-leakage",
    stage="readout",
    equation="y = |y_nominal + ε exp(iψ)|,  a = ε cos ψ, q = ε sin ψ",
    parameters=(
        Parameter("a", "V", lambda s: 0.02 * s.sense_peak),
        Parameter("q", "V", lambda s: 0.02 * s.sense_peak),
    ),
    source="chen2020, section II-C: amplitude demodulation",
    lookalikes={"offset-drift": "it wanders, this stays: record longer; turn the carrier's phase"},
    applies=lambda axis, scales: isinstance(scales.readout, Amdm),
    output=output,
)
