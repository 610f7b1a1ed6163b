"""Named laws that take the bulk of a misfit when no model is exactly right.

Laws are selected in the linear model around a fit, fitted, and selected again around that fit, until the selection no
longer changes. A law that gains less than a free correction beside it imitates something else and is dropped.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from estimation.diagnosis.discrepancy import DISCREPANCY_TERMS
from estimation.diagnosis.fit import Fit, Likelihood, fit_model, misfit
from estimation.diagnosis.initial import estimate_whiteners
from estimation.diagnosis.linear_model import MAX_SCALE_BESIDE, RivalFit
from estimation.diagnosis.linearisation import MAX_CHI2_RATIO, fit_laws, linear_model
from estimation.diagnosis.parameters import Candidate
from estimation.diagnosis.significance import satisfies_sign_constraints

MAX_LINEARISATIONS = 8
"""Fits around which laws are selected, each with the laws selected before."""


SINGLE_LAWS = 6
"""Single laws that are fitted around a discrepancy that follows the motion, where sensitivities do not rank them well.
Each costs a fit."""


def is_discrepancy(candidate: Candidate) -> bool:
    """Whether a term is a discrepancy term."""
    return candidate.term.effect in DISCREPANCY_TERMS


class Choice(NamedTuple):
    """Named laws that explain a recording but for a small remainder.

    Attributes:
        likelihood: under the noise that they leave.
        before, fit: of the nominal device, and of the device with them.
        rivals: other laws in the place of each, by its key.
    """

    likelihood: Likelihood
    before: Fit
    fit: Fit
    rivals: dict[str, tuple[RivalFit, ...]]


def choose_laws(
    anchor: Fit, nominal: Fit, candidates: Sequence[Candidate], progress: Callable[[str], None]
) -> Choice | None:
    """The named laws that take the bulk of a misfit, None where none do.

    Args:
        anchor: a fit that has the phase of the motion right, with any laws or a discrepancy term.
        nominal: the fit of the nominal device.
        candidates: named laws and discrepancy terms.
        progress: called with one line of text at every step.
    """
    fit, fitted, alternates = anchor, dict[frozenset[str], Fit](), False
    for _ in range(MAX_LINEARISATIONS):
        likelihood = Likelihood(fit.model.runs, estimate_whiteners(fit.model, fit.x))
        fit = fit_model(likelihood, fit.model, fit.x)
        linear = linear_model(likelihood, fit, candidates)
        present = tuple(i for i, law in enumerate(linear.laws) if law.test is None)
        if alternates:
            break
        if any(map(is_discrepancy, fit.model.candidates)):
            options = [linear.select().laws, *linear.strongest(SINGLE_LAWS)]
        else:
            options = [linear.select(present, max_moves=1).laws]
        progress("beside a discrepancy: " + " or ".join(map(linear.describe, options)))
        options = [laws for laws in options if laws]
        if not options:
            return None
        if [linear.effects(laws) for laws in options] == [linear.effects(present)]:
            break
        fits = {linear.effects(laws): fit_laws(linear, likelihood, fit, laws, fitted) for laws in options}
        fits = {names: one for names, one in fits.items() if satisfies_sign_constraints(one)}
        if not fits:
            return None
        effects = min(fits, key=lambda names: fits[names].neg2_log_evidence)
        with_laws, alternates = fits[effects], effects in fitted
        if with_laws.chi2 > MAX_CHI2_RATIO * fit.chi2:
            return None
        if alternates and with_laws.neg2_log_evidence > fit.neg2_log_evidence:
            break
        fitted[effects] = fit = with_laws
    else:
        return None
    before = fit_model(likelihood, nominal.model, nominal.x)
    if not linear.are_needed(present, misfit(before) - misfit(fit)):
        return None
    hypothesis = linear.hypothesis(present, max_scale=MAX_SCALE_BESIDE)
    rivals = {linear.laws[i].candidate.key: linear.rivals(hypothesis, i) for i in present}
    return Choice(likelihood, before, fit, rivals)
