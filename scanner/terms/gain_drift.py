"""A readout gain that changes during the recording."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scanner.arrays import Array
from scanner.terms.term import Parameter, SignalContext, Term


def output(signal: Array, p: Sequence[float], context: SignalContext) -> Array:
    g, T = p
    base = signal.mean() if context.variant == "signal" else 0.0
    return base + (signal - base) * (1.0 + g * np.minimum(context.time / T, 1.0))


TERM = Term(
    effect="gain-drift",
    stage="readout",
    equation="y = y_nominal (1 + g t/T),  from T on as at T",
    parameters=(
        Parameter("g", "1", lambda s: 0.12),
        Parameter("T", "s", lambda s: s.duration, kind="fixed"),
    ),
    source="Horowitz & Hill, The Art of Electronics, section 5.1",
    confounders={
        "damping-drift": "a change of damping shows in the angle too: record the angle",
        "offset-drift": "an offset changes no harmonic: record the angle",
    },
    channels=("sense", "sense:signal"),
    output=output,
    drifts=True,
)
