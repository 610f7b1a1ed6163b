"""A detector that is slower than the picture: the light passes a first-order section before it is recorded."""

from __future__ import annotations

from collections.abc import Sequence

from scanner.arrays import Array
from scanner.lowpass import apply_lowpass
from scanner.terms.term import Parameter, SignalContext, Term


def output(signal: Array, p: Sequence[float], context: SignalContext) -> Array:
    (f_c,) = p
    return apply_lowpass(signal, f_c, context.step)


TERM = Term(
    effect="detector-lag",
    stage="optics",
    equation="τ_d I' = L - I, τ_d = 1/(2π f_c)",
    parameters=(Parameter("f_c", "Hz", lambda s: 3e5, kind="inverse", sign=1),),
    source="first-order response of photodiode and amplifier",
    confounders={
        "intensity-delay": "a lag blurs along the line, a delay does not: scan faster, or use a finer target",
    },
    channels=("intensity",),
    output=output,
)
