"""An additional first-order section after the readout."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scanner.terms.term import NATURAL_PHASE_LAG, Parameter, Term


def corners(p: Sequence[float]) -> tuple[float, ...]:
    (f_c,) = p
    return (f_c,)


TERM = Term(
    effect="readout-lag",
    stage="readout",
    equation="y' = 2π f_c (y_nominal − y)",
    parameters=(Parameter("f_c", "Hz", lambda s: s.rate / (2.0 * np.pi * NATURAL_PHASE_LAG), kind="inverse", sign=1),),
    source="Horowitz & Hill, The Art of Electronics, section 1.7",
    confounders={
        "channel-delay": "a delay is the same for all harmonics, without loss: use a larger drive, or two frequencies",
        "drive-lag": "for a linear axis the two commute: record the angle, or use a larger drive",
    },
    corners=corners,
)
