"""Rails: samples that stand exactly at the largest value of a readout, recognised before anything is fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from estimation.diagnosis.data import Run
from estimation.diagnosis.model import Candidate
from scanner.arrays import Array
from scanner.terms import Parameter, Term

MIN_CLIPPED_SAMPLES = 5
"""Samples at one extreme value from which it is a rail: noise gives two or three samples the same largest
value."""

MIN_CLIPPED_RATIO = 3.0
"""Samples at the extreme value over those at the most frequent of the values next to it. A converter's steps have many
samples each, but no more at the top of a swing than this."""

NEIGHBOURS = 8
"""Values next to the extreme one that are compared with it."""


def rail(signal: Array) -> float | None:
    """Magnitude at which a signal of shape (n,) is clipped, None where it is not."""
    size = np.abs(signal)
    values, counts = np.unique(size, return_counts=True)
    if values.size <= NEIGHBOURS or counts[-1] < MIN_CLIPPED_SAMPLES:
        return None
    if counts[-1] < MIN_CLIPPED_RATIO * counts[-1 - NEIGHBOURS : -1].max():
        return None
    return float(values[-1])


def rail_resolution(runs: Sequence[Run], candidate: Candidate) -> float:
    """Half of the step below the rail that a candidate's limit was read from; 0 for a candidate that is fitted."""
    if candidate.term.free_parameters:
        return 0.0
    steps = [
        float(np.diff(np.unique(np.abs(output.full))[-2:])[0])
        for run in runs
        for output in run.outputs
        if output.kind == candidate.channel and candidate.axis in output.axes and rail(output.full) is not None
    ]
    return 0.5 * max(steps, default=0.0)


def clipped_readouts(runs: Sequence[Run], saturation: Term | None) -> list[Candidate]:
    """The saturation of every readout that shows a rail, its limit fixed at the rail.

    Args:
        saturation: the catalogue's term; None where it is not looked for.
    """
    found: dict[str, Candidate] = {}
    for run in runs:
        for output in run.outputs:
            limit = rail(output.full) if saturation is not None and output.kind == "sense" else None
            if limit is not None and saturation is not None:
                fixed = Parameter("limit", "V", lambda scales, limit=limit: limit, kind="fixed")  # type: ignore[misc]
                term = replace(saturation, parameters=(fixed,))
                found.setdefault(output.axes[0], Candidate(term, output.axes[0], "sense"))
    return list(found.values())
