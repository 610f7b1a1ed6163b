"""A tone that neither the drive nor the motion causes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scanner.arrays import Array
from scanner.terms.term import Parameter, SignalContext, Term


def output(signal: Array, p: Sequence[float], context: SignalContext) -> Array:
    a, b, f = p
    phase = 2.0 * np.pi * f * context.time
    return signal + a * np.cos(phase) + b * np.sin(phase)


TERM = Term(
    effect="interference",
    stage="readout",
    equation="y = y_nominal + a cos 2π f t + b sin 2π f t",
    parameters=(
        Parameter("a", "V", lambda s: 0.05 * s.sense_rms),
        Parameter("b", "V", lambda s: 0.05 * s.sense_rms),
        Parameter("f", "Hz", lambda s: s.line or 1.0, kind="line"),
    ),
    source="Ott, Electromagnetic Compatibility Engineering, 2009, chapter 2",
    confounders={"offset-drift": "a drift has no spectral line: record for longer"},
    applies=lambda axis, scales: scales.line is not None,
    output=output,
)
