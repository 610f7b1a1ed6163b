"""Detection of clipped readouts before any fit: many samples exactly at the largest or the smallest value."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from estimation.device_fit.data import Run
from estimation.device_fit.parameters import Candidate
from estimation.rail import upper_rail
from scanner.arrays import Array
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
    """
    if saturation is None:
        return []
    by_axis: dict[str, Candidate] = {}
    for run in runs:
        for output in run.outputs:
            rail = find_rail(output.full) if output.kind == "sense" else None
            if rail is not None:
                fixed = Parameter("limit", "V", lambda scales, limit=rail.limit: limit, kind="fixed")  # type: ignore[misc]
                term = replace(saturation, parameters=(fixed,), channels=saturation.variants)
                by_axis.setdefault(output.axes[0], Candidate(term, output.axes[0], rail.channel))
    return list(by_axis.values())
