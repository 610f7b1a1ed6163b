"""Terms and amplitudes of a fit that the data do not require are removed.

A discrepancy term has dozens of amplitudes, and the evidence charges for each. Unpruned, it would lose against two
named terms even where a law with two of its amplitudes fits better.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from math import comb, log

import numpy as np

from estimation.candidate_terms.screening import is_linear
from estimation.candidate_terms.significance import evidence_gain, residual_is_noise
from estimation.device_fit.fit import Fit, Likelihood, fit_model
from estimation.device_fit.hum import STRONG_HUM, TONE, WEAK_HUM, select_mains_hum
from estimation.device_fit.model import Model, uncertain
from estimation.device_fit.parameters import Candidate
from estimation.least_squares import eliminate_backward, laplace_neg2_log_evidence
from estimation.parallel import map_fits
from scanner.arrays import Array

NONLINEAR_ITERATIONS, NONLINEAR_TOLERANCE = 60, 1e-3
"""Largest number of iterations of the fit with a law that is linear in no amplitude, and the fall of the misfit below
which it ends: the values of a mode that grows lie in a curved valley, along which an ordinary fit left 15 % of an
error."""


def prune_by_evidence(likelihood: Likelihood, fit: Fit) -> Fit | None:
    """Refit with the required amplitudes of the last term, a discrepancy term; None if none is required."""
    candidate = fit.model.candidates[-1]
    required = _required_parameters(fit, fit.model.indices("term", candidate.key))
    if not required:
        return None
    pruned = with_free_parameters(candidate, {fit.model.parameters[i].name for i in required})
    model = fit.model.with_candidates([*fit.model.candidates[:-1], pruned])
    return fit_model(likelihood, model, model.map_parameters_from(fit.model, fit.x))


def with_free_parameters(candidate: Candidate, names: Collection[str]) -> Candidate:
    """A candidate of whose parameters only those with ``names`` are free; the others are fixed at 0.

    Its cost is that of the choice: a priori every number of parameters is equally probable, and of it every subset.
    """
    parameters = tuple(
        p if p.kind == "fixed" or p.name in names else replace(p, kind="fixed", scale=lambda scales: 0.0)
        for p in candidate.term.parameters
    )
    term = replace(candidate.term, parameters=parameters)
    possible, kept = len(candidate.term.free_parameters), len(term.free_parameters)
    return replace(candidate, term=term, cost=2.0 * log(possible * comb(possible, kept)))


def _required_parameters(fit: Fit, indices: list[int]) -> list[int]:
    """Those of the parameters ``indices`` whose removal raises -2 log evidence, to second order around the fit."""
    jacobian, precision, x = fit.jacobian[fit.rows], fit.model.precision, fit.x
    information, slope = jacobian.T @ jacobian, jacobian.T @ fit.residual[fit.rows]

    def neg2_log_evidence(selected: list[int]) -> float:
        free = np.isin(np.arange(x.size), selected)
        step = np.where(free, 0.0, -x)
        gradient = slope + precision * x + information @ step
        inner = information[free][:, free]
        step[free] = -np.linalg.lstsq(inner + np.diag(precision[free]), gradient[free])[0]
        chi2 = fit.chi2 + 2.0 * slope @ step + step @ information @ step
        penalised = float(chi2 + precision @ (x + step) ** 2)
        return laplace_neg2_log_evidence(penalised, inner, precision[free] ** -0.5)

    remaining, _ = eliminate_backward(range(x.size), neg2_log_evidence, removable=indices)
    return [i for i in remaining if i in indices]


def drop_redundant(likelihood: Likelihood, fit: Fit) -> tuple[Fit, dict[str, Fit]]:
    """Refit without the terms that the others make redundant.

    A confounder may be selected first and become redundant when the true effect is added. Hum is selected again with
    and without every term, because in a short recording a drift and one mains frequency resemble the other mains
    frequency.

    Returns:
        The fit, and the fits without each of its terms by key, where there are several.
    """
    fit = select_hum(likelihood, fit)
    terms = uncertain(fit.model) if len(fit.model.candidates) > 1 else []

    def refit(term: Candidate) -> Fit:
        return select_hum(likelihood, refit_without(likelihood, fit, term))

    without = map_fits(refit, terms, likelihood.steps)
    redundant = next((reduced for reduced in without if not evidence_gain(likelihood, reduced, fit)), None)
    if redundant is not None:
        return drop_redundant(likelihood, redundant)
    return fit, {term.key: reduced for term, reduced in zip(terms, without, strict=True)}


def select_hum(likelihood: Likelihood, fit: Fit) -> Fit:
    """The fit with the hum that the recordings show, stronger than the noise only if the fit then leaves noise alone.

    Beside a misfit, strong hum would take a part of it. A tone without harmonics is interference.
    """
    strong = select_mains_hum(likelihood, fit, (*WEAK_HUM, *STRONG_HUM, TONE))
    is_tone = any((mains.harmonics, mains.relative_sd) == TONE for mains in strong.model.mains)
    return strong if residual_is_noise(strong) and not is_tone else select_mains_hum(likelihood, fit)


def fit_to_convergence(likelihood: Likelihood, model: Model, x: Array) -> Fit:
    """``fit_model``, with more and smaller steps, and without an early end, where a law is linear in no amplitude."""
    if all(map(is_linear, uncertain(model))):
        return fit_model(likelihood, model, x)
    return fit_model(likelihood, model, x, max_iterations=NONLINEAR_ITERATIONS, tolerance=NONLINEAR_TOLERANCE)


def refit_without(likelihood: Likelihood, fit: Fit, candidate: Candidate) -> Fit:
    """The fit refitted with one of its terms taken out."""
    model = fit.model.with_candidates([other for other in fit.model.candidates if other is not candidate])
    return fit_to_convergence(likelihood, model, model.map_parameters_from(fit.model, fit.x))
