"""An intensity that is recorded with a delay: cable, digital filter, another converter."""

from __future__ import annotations

from collections.abc import Sequence

from scanner.arrays import Array
from scanner.interpolation import shift_samples
from scanner.terms.term import Parameter, SignalContext, Term


def output(signal: Array, p: Sequence[float], context: SignalContext) -> Array:
    (tau,) = p
    return shift_samples(signal, -tau / context.step)


TERM = Term(
    effect="intensity-delay",
    stage="optics",
    equation="I(t) = L(t - τ)",
    parameters=(Parameter("tau", "s", lambda s: 2e-6, sign=1),),
    source="latency between a detector's and a readout's converters",
    confounders={
        "detector-lag": "a lag blurs along the line, a delay does not: scan faster, or use a finer target",
        "channel-delay": "a delayed sense signal shifts the picture the other way, a phase error shifts one axis only",
    },
    channels=("intensity",),
    output=output,
)
