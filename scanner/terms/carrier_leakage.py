"""Carrier that reaches the detector without passing the comb. It adds to that through the comb as a vector."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scanner.arrays import Array
from scanner.stages import Amdm
from scanner.terms.term import Parameter, SignalContext, Term


def pre_demodulation(capacitance: Array, p: Sequence[float], context: SignalContext) -> Array:
    readout = context.readout
    if not isinstance(readout, Amdm):
        return capacitance
    a, q = (value / readout.a_cir for value in p)
    return np.sqrt((capacitance + a) ** 2 + q**2)


TERM = Term(
    effect="carrier-leakage",
    stage="readout",
    equation="y = a_cir |C + ε exp(iψ)/a_cir| + b_cir,  a = ε cos ψ, q = ε sin ψ",
    parameters=(
        Parameter("a", "V", lambda s: 0.02 * s.sense_peak),
        Parameter("q", "V", lambda s: 0.02 * s.sense_peak),
    ),
    source="chen2020, section II-C: amplitude demodulation",
    confounders={
        "offset-drift": "an offset drifts, leakage is constant: record for longer, or change the carrier's phase"
    },
    applies=lambda axis, scales: isinstance(scales.readout, Amdm),
    pre_demodulation=pre_demodulation,
)
