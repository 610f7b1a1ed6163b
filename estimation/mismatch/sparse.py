"""A free correction without the numbers that it does not need.

Its two dozen numbers make up almost any law of a stage, and all are priced: held against two named terms, a law of two
numbers that fits better would lose. Those that are not worth their price are taken out, one after the other.
"""

from __future__ import annotations

from dataclasses import replace
from math import comb, log

import numpy as np
from numpy.typing import NDArray

from estimation.mismatch.fit import Comparison, Fit, laplace, solve
from estimation.mismatch.model import Candidate, Model

Array = NDArray[np.float64]


def sparse(comparison: Comparison, fit: Fit) -> Fit | None:
    """The fit with the numbers alone that its last, free correction needs; None where it needs none.

    Its evidence has the price of the choice: each set of as many numbers is as probable as any other.
    """
    candidate = fit.model.candidates[-1]
    own = [i for i, f in enumerate(fit.model.free) if f.kind == "term" and f.owner == candidate.key]
    needed = _needed(fit, own)
    if not needed:
        return None
    names = {fit.model.free[i].name for i in needed}
    parameters = tuple(
        each if each.kind == "fixed" or each.name in names else replace(each, kind="fixed", scale=lambda scales: 0.0)
        for each in candidate.term.parameters
    )
    fewer = Candidate(replace(candidate.term, parameters=parameters), candidate.axis, candidate.channel)
    model = Model(fit.model.runs, fit.model.device, [*fit.model.candidates[:-1], fewer], fit.model.mains)
    found = solve(comparison, model, model.embed(fit.model, fit.x))
    return replace(found, evidence=found.evidence + 2.0 * log(comb(len(own), len(needed))))


def _needed(fit: Fit, own: list[int]) -> list[int]:
    """Those of the free numbers ``own`` without which the evidence would rise, to second order about the fit."""
    jacobian, precision, x = fit.jacobian[fit.rows], fit.model.precision, fit.x
    information, slope = jacobian.T @ jacobian, jacobian.T @ fit.residual[fit.rows]

    def evidence(kept: list[int]) -> float:
        on = np.isin(np.arange(x.size), kept)
        step = np.where(on, 0.0, -x)
        push = slope + precision * x + information @ step
        inner = information[on][:, on]
        step[on] = -np.linalg.solve(inner + np.diag(precision[on]), push[on])
        chi2 = fit.chi2 + 2.0 * slope @ step + step @ information @ step
        return laplace(float(chi2 + precision @ (x + step) ** 2), inner, precision[on])

    kept = list(range(x.size))
    least = evidence(kept)
    while True:
        fewer = [[i for i in kept if i != out] for out in kept if out in own]
        best = min(fewer, key=evidence, default=None)
        if best is None or evidence(best) > least:
            return [i for i in kept if i in own]
        kept, least = best, evidence(best)
