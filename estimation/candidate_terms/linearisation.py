"""The linear model around a fit, and fits from estimates in it."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from estimation.candidate_terms.anchor import fit_growing
from estimation.candidate_terms.discrepancy import DISCREPANCY_TERMS, is_discrepancy
from estimation.candidate_terms.linear_model import LinearModel, LinearTerm, columns_of
from estimation.candidate_terms.screening import (
    ScoreTest,
    all_candidates,
    amplitude_indices,
    damped_start,
    is_linear,
    score_candidate_starts,
    set_amplitudes,
)
from estimation.device_fit.fit import Fit, Likelihood, fit_model, nominal_values_are_improbable, stated_values
from estimation.device_fit.initial import window_schedule
from estimation.device_fit.model import uncertain
from estimation.device_fit.parameters import Candidate
from estimation.least_squares import regress
from scanner.arrays import Array

FIT_ITERATIONS = 20
"""Largest number of iterations of a fit from an estimate in the linear model, which may lie in a narrow valley."""

MAX_CHI2_RATIO = 100.0
"""Chi-square of fitted laws over that of the fit around which they were selected, above which the fit has lost the
motion."""

MAX_STARTS = 3
"""Values of a law's time constant or frequency that stand for it in the linear model."""


_Block = tuple[Candidate, Array, ScoreTest | None, float]
"""A term, its sensitivities, shape (N, q), where they were computed, and the cost of its shape parameters."""


def linear_model(likelihood: Likelihood, fit: Fit, candidates: Sequence[Candidate]) -> LinearModel:
    """The linear model around a fit, of its own terms and of ``candidates`` as far as the integrator takes them."""
    base = common_parameters(fit)
    residual = fit.residual - fit.jacobian[:, base] @ fit.x[base]
    blocks: list[_Block] = []
    for candidate in filter(is_linear, uncertain(fit.model)):
        amplitudes = amplitude_indices(fit.model, candidate)
        columns = fit.jacobian[:, amplitudes]
        residual = residual - columns @ fit.x[amplitudes]
        blocks.append((candidate, columns, None, _shape_cost(fit, candidate)))
    return _project_out(fit, base, [*blocks, *_blocks_beside(likelihood, fit, candidates)], residual)


def linear_model_of_corrections(likelihood: Likelihood, fit: Fit) -> LinearModel:
    """The linear model of the corrections of all stages that a fit does not contain, beside all of its parameters."""
    blocks = _blocks_beside(likelihood, fit, all_candidates(fit.model, DISCREPANCY_TERMS.values()))
    return _project_out(fit, list(range(fit.x.size)), blocks, fit.residual - fit.jacobian @ fit.x)


def _blocks_beside(likelihood: Likelihood, fit: Fit, candidates: Sequence[Candidate]) -> list[_Block]:
    """Candidates that a fit does not contain, as far as the integrator takes them."""
    present = {candidate.key for candidate in fit.model.candidates}
    others = [
        candidate
        for candidate in candidates
        if candidate.key not in present
        and is_linear(candidate)
        and fit.model.has_room_for(candidate.axis, candidate.term)
    ]
    return [
        (test.candidate, test.columns, test, 2.0 * float(np.log(len(tests))))
        for tests in score_candidate_starts(likelihood, fit, others)
        for test in _linear_starts(tests)
    ]


def _project_out(fit: Fit, base: list[int], blocks: Sequence[_Block], residual: Array) -> LinearModel:
    """The linear model of terms beside the parameters ``base`` of a fit.

    Args:
        residual: without the terms and without these parameters, shape (N,).
    """
    rows = fit.rows
    whole = np.column_stack([*(columns[rows] for _, columns, *_ in blocks), residual[rows]])
    common = regress(fit.jacobian[rows][:, base], whole, fit.model.precision[base])
    profile = np.asarray(np.linalg.solve(common.factor, common.projected))
    ends = np.cumsum([0, *(columns.shape[1] for _, columns, *_ in blocks)])
    terms = [
        LinearTerm(candidate, np.arange(low, high), test, cost)
        for (candidate, _, test, cost), (low, high) in zip(blocks, pairwise(ends), strict=True)
    ]
    discrepancies = tuple(term for term in terms if is_discrepancy(term.candidate))
    laws = tuple(term for term in terms if not is_discrepancy(term.candidate))
    cost = common.log_determinant - float(np.log(fit.model.precision[base]).sum())
    return LinearModel(common.remainder, profile, laws, discrepancies, cost)


def _linear_starts(tests: Sequence[ScoreTest]) -> list[ScoreTest]:
    """The best starts of one candidate, where it has an effect."""
    with_effect = [test for test in tests if np.any(test.columns)]
    most = 1 if is_discrepancy(tests[0].candidate) else MAX_STARTS
    return sorted(with_effect, key=lambda test: -test.predicted_gain)[:most]


def _shape_cost(fit: Fit, candidate: Candidate) -> float:
    """-2 log of posterior over prior volume of the parameters of a term that are no amplitude."""
    amplitudes = amplitude_indices(fit.model, candidate)
    at = [i for i in fit.model.indices("term", candidate.key) if i not in amplitudes]
    return -float(np.linalg.slogdet(fit.covariance[np.ix_(at, at)])[1]) if at else 0.0


def common_parameters(fit: Fit) -> list[int]:
    """Indices of the parameters of a fit that belong to no term that is linear in an amplitude."""
    linear = {candidate.key for candidate in fit.model.candidates if is_linear(candidate)}
    return [i for i, f in enumerate(fit.model.parameters) if f.kind not in ("term", "hidden") or f.owner not in linear]


def fit_terms(
    linear: LinearModel,
    likelihood: Likelihood,
    fit: Fit,
    terms: Sequence[LinearTerm],
    max_ratio: float = MAX_CHI2_RATIO,
) -> Fit:
    """The fit with these terms and no others, from their estimates in the linear model.

    Where these do not follow the motion, it is made over windows of increasing length. So it is where the nominal
    values of ``fit`` lie improbably far from the stated ones: they have absorbed what the terms now explain, and the
    way back leads through a long curved valley. Then it begins at the stated values.

    Args:
        fit: around which the model is linear.
        max_ratio: chi-square over that of ``fit`` above which the result is of no use. It is the fit over a window
            where that shows it.
    """
    at, estimates = columns_of(terms), linear.estimate(terms)
    kept = [candidate for candidate in fit.model.candidates if not is_linear(candidate)]
    model = fit.model.with_candidates([*kept, *(term.candidate for term in terms)])
    start = fit.x.copy()
    start[common_parameters(fit)] = -(linear.profile[:, at] @ estimates + linear.profile[:, -1])
    x = model.map_parameters_from(fit.model, start)
    without = model.map_parameters_from(fit.model, fit.x)
    ends = np.cumsum([0, *(term.columns.size for term in terms)])
    for term, (low, high) in zip(terms, pairwise(ends), strict=True):
        if term.test is not None:
            key = term.candidate.key
            at_term = model.indices("term", key)
            x[at_term] = without[at_term] = term.test.x[term.test.model.indices("term", key)]
        set_amplitudes(x, model, term.candidate, estimates[low:high])
    start = damped_start(likelihood, fit, model, without, x - without)
    residual = likelihood.residual(model, start)[fit.rows]
    follows = residual @ residual < MAX_CHI2_RATIO * fit.chi2
    absorbed = nominal_values_are_improbable(fit)
    if absorbed or not follows:
        most = fit.chi2 if follows else max_ratio * fit.chi2
        begin = stated_values(model, x) if absorbed else x
        grown = fit_growing(likelihood, model, begin, window_schedule(model)[0], abort_above=most)
        if absorbed and grown.chi2 < fit.chi2 and not nominal_values_are_improbable(grown):
            return fit_model(likelihood, model, grown.x)
        if not follows:
            return grown
    return fit_model(likelihood, model, start, max_iterations=FIT_ITERATIONS, abort_above=max_ratio * fit.chi2)
