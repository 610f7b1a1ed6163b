"""A sample that moves at constant velocity during the scan."""

from __future__ import annotations

from collections.abc import Sequence

from scanner.arrays import Array
from scanner.terms.term import Parameter, SignalContext, Term


def output(signal: Array, p: Sequence[float], context: SignalContext) -> Array:
    (v,) = p
    return signal - v * context.time


TERM = Term(
    effect="sample-motion",
    stage="optics",
    equation="s = θ - v t",
    parameters=(Parameter("v", "rad/s", lambda s: 0.03 * s.amplitude / s.duration),),
    source="uniform motion of the sample, expressed as the rate at which the mirror would follow it",
    confounders={
        "resonance-drift": "a phase drift shifts forward and backward lines apart, a moving sample shifts both equally"
    },
    channels=("place",),
    output=output,
)
