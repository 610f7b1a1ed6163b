"""Inertia, damping and stiffness all wrong by one factor. A ringdown does not depend on it, a torque does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from scanner.device import Axis
from scanner.stages import Mechanics
from scanner.terms.term import Parameter, Term


def constants(axis: Axis, p: Sequence[float]) -> Axis:
    (s,) = p
    m = axis.require_mechanics()
    return replace(axis, mechanics=Mechanics(s * m.J, s * m.b, s * m.k))


TERM = Term(
    effect="inertia-scale",
    stage="mechanics",
    equation="s (J θ'' + b θ' + k θ) = τ",
    parameters=(Parameter("s", "1", lambda s: 1.0, kind="factor", spread=0.2),),
    source="chen2020, Table II: as printed it cannot oscillate, with s near 0.09 it does",
    confounders={"drive-droop": "droop scales the alternating part of the drive only: change the bias"},
    constants=constants,
    applies=lambda axis, scales: scales.voltage_mean**2 + scales.voltage_rms**2 > 0,
)
