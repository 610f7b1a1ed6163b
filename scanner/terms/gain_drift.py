"""A readout gain that changes while the recording runs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scanner.terms.term import Parameter, Term, View

Array = NDArray[np.float64]


def output(signal: Array, p: Sequence[float], view: View) -> Array:
    base = signal.mean() if view.variant == "signal" else 0.0
    return base + (signal - base) * (1.0 + p[0] * view.time / p[1])


TERM = Term(
    effect="gain-drift",
    stage="readout",
    equation="y = y_nominal (1 + g t/T)",
    parameters=(
        Parameter("g", "1", lambda s: 0.12),
        Parameter("T", "s", lambda s: s.duration, kind="fixed"),
    ),
    source="Horowitz & Hill, The Art of Electronics, section 5.1",
    lookalikes={
        "damping-drift": "the angle shows it too: record the angle",
        "offset-drift": "no harmonic changes: record the angle",
    },
    channels=("sense", "sense:signal"),
    output=output,
)
