"""An envelope detector that squares: the gain depends on the capacitance itself."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scanner.device import Amdm
from scanner.terms.term import Parameter, Term, View

Array = NDArray[np.float64]


def modulate(capacitance: Array, p: Sequence[float], view: View) -> Array:
    change = capacitance - capacitance.mean()
    return capacitance + p[0] * change * change


TERM = Term(
    effect="square-law",
    stage="readout",
    equation="y ∝ (C + C_p)²:  C → C + w (C − C̄)²,  w = 1/(2 (C̄ + C_p))",
    parameters=(Parameter("w", "1/F", lambda s: 3e10, sign=1),),
    source="chen2020, appendix: detector a_d v + b_d v²",
    lookalikes={"profile-shape": "the circuit's C_p does not change it: change the circuit, or record the angle"},
    applies=lambda axis, scales: isinstance(scales.readout, Amdm),
    modulate=modulate,
)
