"""An envelope detector with a square law: the gain depends on the capacitance."""

from __future__ import annotations

from collections.abc import Sequence

from scanner.arrays import Array
from scanner.stages import Amdm
from scanner.terms.term import Parameter, SignalContext, Term


def pre_demodulation(capacitance: Array, p: Sequence[float], context: SignalContext) -> Array:
    (w,) = p
    change = capacitance - capacitance.mean()
    return capacitance + w * change * change


TERM = Term(
    effect="square-law",
    stage="readout",
    equation="y ∝ (C + C_p)²:  C → C + w (C − C̄)²,  w = 1/(2 (C̄ + C_p))",
    parameters=(Parameter("w", "1/F", lambda s: 3e10, sign=1),),
    source="chen2020, appendix: detector a_d v + b_d v²",
    confounders={
        "profile-shape": "the profile does not depend on the circuit's C_p: change the circuit, or record the angle"
    },
    applies=lambda axis, scales: isinstance(scales.readout, Amdm),
    pre_demodulation=pre_demodulation,
)
