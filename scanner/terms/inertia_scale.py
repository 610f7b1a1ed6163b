"""Inertia, damping and stiffness all off by one factor: a ringdown cannot see it, a torque can."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from scanner.device import Axis, Mechanics
from scanner.terms.term import Parameter, Term


def constants(axis: Axis, p: Sequence[float]) -> Axis:
    m = axis.require_mechanics()
    return replace(axis, mechanics=Mechanics(p[0] * m.J, p[0] * m.b, p[0] * m.k))


TERM = Term(
    effect="inertia-scale",
    stage="mechanics",
    equation="s (J θ'' + b θ' + k θ) = τ",
    parameters=(Parameter("s", "1", lambda s: 1.0, kind="factor", spread=0.2),),
    source="chen2020, Table II: as printed it cannot oscillate, with s near 0.09 it does",
    lookalikes={"drive-droop": "it scales only the alternating part of the drive: change the bias"},
    constants=constants,
    applies=lambda axis, scales: scales.voltage_mean**2 + scales.voltage_rms**2 > 0,
)
