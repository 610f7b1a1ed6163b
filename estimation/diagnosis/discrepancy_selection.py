"""The free correction of one stage that explains a recording best, where no laws do."""

from __future__ import annotations

from collections.abc import Sequence

from estimation.candidate_terms.curves import REFINED_CURVES
from estimation.candidate_terms.linearisation import MAX_CHI2_RATIO, fit_terms, linear_model
from estimation.candidate_terms.significance import evidence_gain
from estimation.device_fit.fit import Fit, Likelihood, fit_model, nominal_values_are_improbable
from estimation.device_fit.initial import refit_under_own_noise
from estimation.device_fit.parameters import Candidate
from estimation.diagnosis.from_stated_values import fit_from_stated_values
from estimation.diagnosis.law_selection import SelectedTerms
from estimation.diagnosis.pruning import prune_by_evidence
from estimation.diagnosis.rival_stages import find_rival_stages
from estimation.diagnosis.search import Search
from estimation.parallel import map_fits

MAX_DISCREPANCY_FITS = 3
"""Number of discrepancy terms that are fitted, those with the best evidence in the linear model. Each costs a fit."""


def choose_discrepancy(search: Search, anchor: Fit, fitted: Sequence[Fit]) -> SelectedTerms | None:
    """The discrepancy term with the best evidence, with the amplitudes that the recording requires; None if none is.

    Args:
        fitted: fits of discrepancy terms that have been made.
    """
    likelihood, anchor = refit_under_own_noise(anchor)
    linear = linear_model(likelihood, anchor, [*search.discrepancies, *search.curves])
    stages = range(len(linear.discrepancies))
    alone = {i: linear.hypothesis((), without=[j for j in stages if j != i]).neg2_log_evidence for i in stages}
    fits = map_fits(lambda fit: fit_model(likelihood, fit.model, fit.x), fitted, likelihood.steps)
    fits += map_fits(
        lambda i: fit_terms(linear, likelihood, anchor, [linear.discrepancies[i]]),
        sorted(stages, key=lambda i: alone[i])[:MAX_DISCREPANCY_FITS],
        likelihood.steps,
    )
    if nominal_values_are_improbable(search.nominal):
        search.progress("stated values, with curves of drive and readout")
        fits += map_fits(
            lambda curve: fit_from_stated_values(likelihood, search.nominal, [curve], search.stops[0]),
            search.curves,
            likelihood.steps,
        )
    converged = [fit for fit in fits if fit.chi2 < MAX_CHI2_RATIO * anchor.chi2]
    reduced = map_fits(lambda fit: prune_by_evidence(likelihood, fit), converged, likelihood.steps)
    pruned = [fewer for fewer in reduced if fewer is not None]
    if not pruned:
        return None
    best = with_refined_curve(likelihood, min(pruned, key=lambda fit: fit.neg2_log_evidence))
    likelihood, best = refit_under_own_noise(best)
    before = fit_model(likelihood, search.nominal.model, search.nominal.x)
    if not evidence_gain(likelihood, before, best):
        return None
    rivals = find_rival_stages(likelihood, best, search.discrepancies)
    return SelectedTerms(likelihood, before, best, {best.model.candidates[-1].key: rivals})


def with_refined_curve(likelihood: Likelihood, fit: Fit) -> Fit:
    """A fit whose last term is a curve, with those parameters of all levels of its table that the recording requires.

    The fit itself if the curve has no better evidence then, or if its last term is another one.
    """
    *others, candidate = fit.model.candidates
    if candidate.term.effect not in REFINED_CURVES:
        return fit
    finer = Candidate(REFINED_CURVES[candidate.term.effect], candidate.axis, candidate.channel)
    model = fit.model.with_candidates([*others, finer])
    refined = fit_model(likelihood, model, model.map_parameters_from(fit.model, fit.x))
    pruned = prune_by_evidence(likelihood, refined)
    return min((each for each in (fit, pruned) if each is not None), key=lambda each: each.neg2_log_evidence)
