"""A reference detector whose output is not proportional to the angle (arctangent or cubic)."""

from __future__ import annotations

from collections.abc import Sequence

from scanner.arrays import Array
from scanner.terms.term import Parameter, SignalContext, Term


def output(signal: Array, p: Sequence[float], context: SignalContext) -> Array:
    (c3,) = p
    return signal * (1.0 + c3 * signal * signal)


TERM = Term(
    effect="angle-nonlinearity",
    stage="optics",
    equation="θ_ref = θ (1 + c3 θ²)",
    parameters=(Parameter("c3", "1/rad^2", lambda s: 0.03 / s.amplitude**2),),
    source="chen2019, eq. 10: θ = arctan(y G/L)",
    confounders={"cubic-stiffness": "cubic stiffness shows in the sense signal and in the angle: compare them"},
    channels=("angle",),
    output=output,
)
