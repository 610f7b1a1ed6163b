"""A sample whose light decays exponentially. A laser that dims has the same law."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scanner.arrays import Array
from scanner.terms.term import Parameter, SignalContext, Term


def output(signal: Array, p: Sequence[float], context: SignalContext) -> Array:
    (tau,) = p
    return signal * np.exp(-context.time / tau)


TERM = Term(
    effect="bleaching",
    stage="optics",
    equation="I(t) = L e^(-t/τ)",
    parameters=(Parameter("tau", "s", lambda s: 2.0 * s.duration, kind="inverse", sign=1),),
    source="single-exponential photobleaching of a fluorophore under constant light",
    channels=("intensity",),
    output=output,
    drifts=True,
)
