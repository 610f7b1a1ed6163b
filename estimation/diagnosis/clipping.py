"""Detection of clipped readouts before any fit: many samples exactly at the largest or the smallest value."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np

from estimation.device_fit.data import Output, Run
from estimation.device_fit.parameters import Candidate
from estimation.rail import MIN_CLIPPED_SAMPLES, upper_rail
from scanner.arrays import Array
from scanner.errors import BadInput
from scanner.terms import Parameter, Term

SAME_LIMIT = 0.02
"""Relative difference of two rails up to which they are one limit: converters are as symmetric."""


class Rail(NamedTuple):
    """Where a signal is clipped.

    Attributes:
        limit: L of the saturation term [V].
        channel: of the term: ``"sense"`` (-L and L), ``"sense:upper"`` (L alone) or ``"sense:lower"`` (-L alone).
        samples: that stand exactly at the rail.
    """

    limit: float
    channel: str
    samples: int


def find_rail(signal: Array) -> Rail | None:
    """The rail of a signal of shape (n,), None where it is not clipped.

    Two rails of one magnitude are one limit. Of two others the one with more samples is taken. A single rail is one of
    two, of which the other was not reached, where no sample exceeds its magnitude on the other side.
    """
    upper, lower = upper_rail(signal), upper_rail(-signal)
    if upper and lower and np.isclose(upper[0], lower[0], rtol=SAME_LIMIT):
        return Rail(max(upper[0], lower[0]), "sense", upper[1] + lower[1])
    found = [
        Rail(rail[0], "sense" if rail[0] > 0.0 and opposite.max() <= rail[0] else channel, rail[1])
        for rail, opposite, channel in ((upper, -signal, "sense:upper"), (lower, signal, "sense:lower"))
        if rail
    ]
    return max(found, key=lambda rail: rail.samples, default=None)


def rail_resolution(runs: Sequence[Run], candidate: Candidate) -> float:
    """Uncertainty of a limit read from the rail: half the step to the next value; 0 for a fitted candidate."""
    if candidate.term.free_parameters:
        return 0.0
    steps = []
    for run in runs:
        for output in run.outputs:
            if output.kind == "sense" and candidate.axis in output.axes and find_rail(output.full) is not None:
                signal = {"sense:upper": output.full, "sense:lower": -output.full}.get(
                    candidate.channel, np.abs(output.full)
                )
                steps.append(float(np.diff(np.unique(signal)[-2:])[0]))
    return 0.5 * max(steps, default=0.0)


def clipped_readouts(runs: Sequence[Run], saturation: Term | None) -> list[Candidate]:
    """The saturation term of every readout that is clipped, with its limit fixed at the rail.

    Args:
        saturation: the catalogue's term; None if saturation is not a candidate.

    Raises:
        BadInput: a recording exceeds the rail of another: they have different ranges, and no limit is that of both.
    """
    if saturation is None:
        return []
    recorded: dict[str, list[tuple[str, Output]]] = {}
    for run in runs:
        for output in run.outputs:
            if output.kind == "sense":
                recorded.setdefault(output.axes[0], []).append((run.name, output))
    candidates = []
    for axis, of_axis in recorded.items():
        _check_ranges(of_axis)
        rail = find_rail(np.concatenate([output.full for _, output in of_axis]))
        if rail is not None:
            candidates.append(_at_rail(saturation, axis, rail))
    return candidates


def _check_ranges(recorded: Sequence[tuple[str, Output]]) -> None:
    """Refuse recordings of one readout, by their names, of which one lies beyond the rail of another."""
    for (name, output), side in product(recorded, (1.0, -1.0)):
        rail = upper_rail(side * output.full)
        if rail is None:
            continue
        limit = rail[0] + SAME_LIMIT * abs(rail[0])
        beyond = [each for each, o in recorded if np.count_nonzero(side * o.full > limit) >= MIN_CLIPPED_SAMPLES]
        if beyond:
            what = f"is clipped at {side * rail[0]:.4g} V in {name}, which {beyond[0]} exceeds"
            raise BadInput(what, channel=output.name, hint="diagnose recordings of different ranges one by one")


def _at_rail(saturation: Term, axis: str, rail: Rail) -> Candidate:
    fixed = Parameter("limit", "V", lambda scales: rail.limit, kind="fixed")
    return Candidate(replace(saturation, parameters=(fixed,), channels=saturation.variants), axis, rail.channel)
