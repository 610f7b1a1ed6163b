"""A distorted field: the position of the beam is not proportional to the angle of the mirror."""

from __future__ import annotations

from collections.abc import Sequence

from scanner.arrays import Array
from scanner.terms.term import Parameter, SignalContext, Term


def output(signal: Array, p: Sequence[float], context: SignalContext) -> Array:
    (c3,) = p
    return signal * (1.0 + c3 * signal * signal)


TERM = Term(
    effect="field-distortion",
    stage="optics",
    equation="s = θ (1 + c3 θ²)",
    parameters=(Parameter("c3", "1/rad^2", lambda s: 0.02 / s.amplitude**2),),
    source="tan 2θ = 2θ (1 + 4/3 θ²) before a flat field, third order of an objective's distortion",
    confounders={"angle-nonlinearity": "only a distorted field bends a straight line on the sample"},
    channels=("place",),
    output=output,
)
