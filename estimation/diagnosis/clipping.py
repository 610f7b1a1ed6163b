"""Detection of clipped readouts before any fit: many samples exactly at the largest value, the rail."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from estimation.diagnosis.data import Run
from estimation.diagnosis.parameters import Candidate
from scanner.arrays import Array
from scanner.terms import Parameter, Term

MIN_CLIPPED_SAMPLES = 5
"""Number of samples at the extreme value from which it is a rail. By noise alone two or three samples share the largest
value of a converter."""

MIN_CLIPPED_RATIO = 3.0
"""Number of samples at the extreme value over that at the most frequent value next to it. A sine without clipping
already has more samples at its turning points, but by less than this factor."""

NEIGHBOURS = 8
"""Distinct values next to the extreme one whose sample counts are compared with its own."""


def rail(signal: Array) -> float | None:
    """Magnitude at which a signal of shape (n,) is clipped, None where it is not."""
    magnitude = np.abs(signal)
    values, counts = np.unique(magnitude, return_counts=True)
    if values.size <= NEIGHBOURS or counts[-1] < MIN_CLIPPED_SAMPLES:
        return None
    if counts[-1] < MIN_CLIPPED_RATIO * counts[-1 - NEIGHBOURS : -1].max():
        return None
    return float(values[-1])


def rail_resolution(runs: Sequence[Run], candidate: Candidate) -> float:
    """Uncertainty of a limit read from the rail: half the step to the next lower value; 0 for a fitted candidate."""
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
    """The saturation term of every readout that is clipped, with its limit fixed at the rail.

    Args:
        saturation: the catalogue's term; None if saturation is not a candidate.
    """
    by_axis: dict[str, Candidate] = {}
    for run in runs:
        for output in run.outputs:
            limit = rail(output.full) if saturation is not None and output.kind == "sense" else None
            if limit is not None and saturation is not None:
                fixed = Parameter("limit", "V", lambda scales, limit=limit: limit, kind="fixed")  # type: ignore[misc]
                term = replace(saturation, parameters=(fixed,))
                by_axis.setdefault(output.axes[0], Candidate(term, output.axes[0], "sense"))
    return list(by_axis.values())
