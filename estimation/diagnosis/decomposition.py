"""The misfit of a channel divided among the findings, and what no finding explains."""

from __future__ import annotations

from typing import Any

import numpy as np

from estimation.diagnosis.discrepancy import DISCREPANCY_TERMS
from estimation.diagnosis.screening import all_candidates, score_candidates
from estimation.diagnosis.selection import SelectionResult, SelectionStep
from estimation.diagnosis.shares import left_by, noise_of, remainder_of, share_of

MAX_HELD_OUT_CHI2 = 1.3
"""Held-out reduced chi-square above which something is left to explain."""

MAX_UNEXPLAINED_SHARE = 0.1
"""Share of a channel's deviation that a fit may leave, noise aside, and still be called consistent: a tenth of the
signal is visible in a plot whatever its chi-square."""

MIN_REMAINDER_SHARE = 1e-3
"""Share of the misfit below which no remainder is stated: held-out samples scatter by as much."""


def share(found: SelectionResult, each: SelectionStep) -> float:
    """Share of the misfit of its channel that a finding alone explains."""
    name, noise = _channel(found, each), noise_of(found.likelihood)
    without, complete, nominal = (left_by(fit)[name] for fit in (each.before, found.final, found.nominal))
    return share_of(without, complete, nominal, noise[name])


def remainder(found: SelectionResult) -> dict[str, Any] | None:
    """What no finding explains, in the channel where that is most: its share, and the stage that would take most of it.

    None where that is noise.
    """
    if found.final.validation_chi2 < MAX_HELD_OUT_CHI2:
        return None
    noise, complete, nominal = noise_of(found.likelihood), left_by(found.final), left_by(found.nominal)
    left, name = max((remainder_of(complete[key], nominal[key], noise[key]), key) for key in complete)
    if left < MIN_REMAINDER_SHARE:
        return None
    present = {each.key for each in found.final.model.candidates}
    free = all_candidates(found.final.model.device, found.final.model, DISCREPANCY_TERMS.values())
    beside = score_candidates(found.likelihood, found.final, [each for each in free if each.key not in present])
    most = max(beside, key=lambda each: each.predicted_gain, default=None)
    stage = "readout" if most is None else most.candidate.term.stage
    return {"share": left, "stage": stage, "channel": name}


def unexplained(found: SelectionResult) -> str | None:
    """In words: what is left, None where nothing is."""
    parts, level = [], found.final.validation_chi2
    if level > MAX_HELD_OUT_CHI2:
        parts.append(f"held-out reduced chi-square is still {level:.2f}")
    noise = noise_of(found.likelihood)
    for name, value in left_by(found.final).items():
        data = [output.data for run in found.likelihood.runs for output in run.outputs if output.name == name]
        deviation = float(np.sqrt(np.mean([each.var() for each in data])))
        rest = float(np.sqrt(max(0.0, value - noise[name])))
        if level > MAX_HELD_OUT_CHI2 and rest > MAX_UNEXPLAINED_SHARE * deviation:
            parts.append(f"{rest / deviation:.0%} of {name} is not explained")
    return "; ".join(parts) or None


def _channel(found: SelectionResult, each: SelectionStep) -> str:
    """The channel in which a finding shows: the one it acts on, else the first that its axis is sensed in."""
    outputs = [output for run in found.likelihood.runs for output in run.outputs if each.candidate.axis in output.axes]
    acted = [output.name for output in outputs if output.kind == each.candidate.channel.partition(":")[0]]
    return (acted or [output.name for output in outputs])[0]
