"""Channels whose clocks run at different rates."""

from __future__ import annotations

from collections.abc import Sequence

from scanner.arrays import Array
from scanner.terms.term import Parameter, Term


def clock(time: Array, p: Sequence[float]) -> Array:
    (skew,) = p
    return (1.0 + skew) * time


TERM = Term(
    effect="clock-skew",
    stage="timing",
    equation="y(t) = y_nominal((1 + ε) t)",
    parameters=(Parameter("skew", "1", lambda s: 5e-5),),
    source="IEEE 1588: drift of free-running oscillators, 1 to 200 ppm",
    confounders={"resonance-drift": "a drift changes the amplitude as well: drive the mirror, or record the angle"},
    channels=("sense", "angle"),
    clock=clock,
)
