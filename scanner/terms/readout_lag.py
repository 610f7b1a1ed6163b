"""One more first-order section behind the readout."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scanner.terms.term import Parameter, Term


def corners(p: Sequence[float]) -> tuple[float, ...]:
    return (p[0],)


TERM = Term(
    effect="readout-lag",
    stage="readout",
    equation="y' = 2π f_c (y_nominal − y)",
    parameters=(Parameter("f_c", "Hz", lambda s: 15.0 * s.rate / (2.0 * np.pi), kind="inverse", sign=1),),
    source="Horowitz & Hill, The Art of Electronics, section 1.7",
    lookalikes={
        "channel-delay": "a delay turns all harmonics by one time, shrinks none: drive harder, or at two frequencies",
        "drive-lag": "for a linear axis the two commute: record the angle, or drive harder",
    },
    corners=corners,
)
