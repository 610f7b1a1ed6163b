"""An intensity that is recorded late: cable, digital filter, another converter."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scanner.terms.term import Parameter, Term, View, shifted

Array = NDArray[np.float64]


def output(signal: Array, p: Sequence[float], view: View) -> Array:
    return shifted(signal, -p[0] / view.step)


TERM = Term(
    effect="intensity-delay",
    stage="optics",
    equation="I(t) = L(t - τ)",
    parameters=(Parameter("tau", "s", lambda s: 2e-6, sign=1),),
    source="latency between a detector's and a readout's converters",
    lookalikes={
        "detector-lag": "a lag blurs along the sweep, a delay does not: scan faster, or a target with fine detail",
        "channel-delay": "a late sense signal moves the picture the other way; a phase error moves one axis only",
    },
    channels=("intensity",),
    output=output,
)
