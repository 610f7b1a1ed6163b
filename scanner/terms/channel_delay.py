"""One channel comes later than the others say."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scanner.terms.term import Parameter, Term

Array = NDArray[np.float64]


def clock(time: Array, p: Sequence[float]) -> Array:
    return time - p[0]


TERM = Term(
    effect="channel-delay",
    stage="timing",
    equation="y(t) = y_nominal(t − τ)",
    parameters=(Parameter("delay", "s", lambda s: 0.1 / s.rate, sign=1),),
    source="chen2019, section IV: 0.114 ms between position detector and sense signal",
    lookalikes={
        "readout-lag": "a lag shrinks the harmonics and turns each differently: drive harder, or at two frequencies",
        "drive-lag": "the angle comes late too: record the angle",
    },
    channels=("sense", "angle"),
    clock=clock,
)
