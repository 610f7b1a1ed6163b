"""A detector slower than the picture: light passes a first-order section before it is recorded."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scanner.terms.term import Parameter, Term, View, section

Array = NDArray[np.float64]


def output(signal: Array, p: Sequence[float], view: View) -> Array:
    return section(signal, p[0], view.step)


TERM = Term(
    effect="detector-lag",
    stage="optics",
    equation="τ_d I' = L - I, τ_d = 1/(2π f_c)",
    parameters=(Parameter("f_c", "Hz", lambda s: 3e5, kind="inverse", sign=1),),
    source="first-order response of photodiode and amplifier",
    lookalikes={
        "intensity-delay": "a lag blurs along the sweep, a delay does not: scan faster, or a target with fine detail",
    },
    channels=("intensity",),
    output=output,
)
