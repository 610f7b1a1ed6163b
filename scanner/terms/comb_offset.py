"""Combs whose largest capacitance is not at the rest position of the mirror."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from scanner.device import Axis
from scanner.terms.term import Parameter, Term


def constants(axis: Axis, p: Sequence[float]) -> Axis:
    (theta_c,) = p
    comb = axis.require_capacitance()
    return replace(axis, capacitance=replace(comb, theta_th=comb.theta_th + theta_c))


TERM = Term(
    effect="comb-offset",
    stage="capacitance",
    equation="C(θ − θ_c)",
    parameters=(Parameter("theta_c", "rad", lambda s: 0.007),),
    source="chen2020, section II-C: angle of the largest capacitance",
    confounders={"quadratic-stiffness": "quadratic stiffness shows in the angle too: record the angle"},
    constants=constants,
    applies=lambda axis, scales: axis.capacitance is not None,
)
