"""Named laws that take the bulk of a misfit when no model is exactly right.

Laws are selected in the linear model around a fit, fitted, and selected again around that fit, until the selection no
longer changes. A law that gains less than a free correction beside it imitates something else and is dropped.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from estimation.diagnosis.discrepancy import DISCREPANCY_TERMS
from estimation.diagnosis.exchange import RivalFit
from estimation.diagnosis.fit import Fit, Likelihood, fit_model
from estimation.diagnosis.initial import estimate_whiteners
from estimation.diagnosis.linear_model import MAX_SCALE_BESIDE, LinearModel, common_parameters, linear_model
from estimation.diagnosis.model import Model, uncertain
from estimation.diagnosis.parameters import Candidate
from estimation.diagnosis.pruning import refit_without
from estimation.diagnosis.screening import is_linear, set_amplitudes

MAX_LINEARISATIONS = 4
"""Fits around which laws are selected, each with the laws selected before."""

MAX_RESIDUAL_RATIO = 0.3
"""Residual over signal, both as standard deviations, up to which a fit has the phase of the motion right."""

MAX_CHI2_RATIO = 100.0
"""Chi-square of the selected laws over that of the fit around which they were selected, above which they were not
linear."""

SMALL_LAW_MARGIN = 25.0
"""Advantage in -2 log evidence over a discrepancy without laws that laws need if they gain less than the corrections
beside them. A quintic spring that imitates a delay with memory has 12, a drift beside an imperfect readout 62."""


class Choice(NamedTuple):
    """Named laws that explain a recording but for a small remainder.

    Attributes:
        likelihood: under the noise that they leave.
        fit: of the device with them.
        rivals: other laws in the place of each, by its key.
    """

    likelihood: Likelihood
    fit: Fit
    rivals: dict[str, tuple[RivalFit, ...]]


def choose_laws(anchor: Fit, candidates: Sequence[Candidate], progress: Callable[[str], None]) -> Choice | None:
    """The named laws that take the bulk of a misfit, None where none do.

    Args:
        anchor: a fit with any laws.
        candidates: named laws and discrepancy terms.
        progress: called with one line of text at every step.
    """
    fit = anchor
    if not any(candidate.term.effect in DISCREPANCY_TERMS for candidate in candidates):
        return None  # every law would be compared with noise alone
    if not _follows(fit) or not all(is_linear(candidate) for candidate in uncertain(fit.model)):
        return None
    tried: list[set[str]] = []
    for _ in range(MAX_LINEARISATIONS):
        likelihood = Likelihood(fit.model.runs, estimate_whiteners(fit.model, fit.x))
        fit = fit_model(likelihood, fit.model, fit.x)
        linear = linear_model(likelihood, fit, candidates)
        present = tuple(i for i, law in enumerate(linear.laws) if law.test is None)
        laws = linear.select().laws
        progress(f"beside a discrepancy: {', '.join(sorted(linear.effects(laws))) or 'no named law'}")
        if not laws:
            return None
        if linear.effects(laws) == linear.effects(present):
            break
        with_laws = _fit_laws(likelihood, fit, linear, laws)
        if with_laws.chi2 > MAX_CHI2_RATIO * fit.chi2:
            return None
        effects = linear.effects(laws)
        if effects in tried and with_laws.neg2_log_evidence > fit.neg2_log_evidence:
            break
        tried.append(effects)
        fit = with_laws
    else:
        return None
    laws, fit, gain = _without_imitations(likelihood, fit, linear, present)
    margin = 0.0 if gain > linear.gain_of_discrepancy(laws) else SMALL_LAW_MARGIN
    if not laws or not linear.are_needed(laws, SMALL_LAW_MARGIN, margin):
        return None
    hypothesis = linear.hypothesis(laws, max_scale=MAX_SCALE_BESIDE)
    rivals = {linear.laws[i].candidate.key: linear.rivals(hypothesis, i) for i in laws}
    return Choice(likelihood, fit, rivals)


def _without_imitations(
    likelihood: Likelihood, fit: Fit, linear: LinearModel, laws: tuple[int, ...]
) -> tuple[tuple[int, ...], Fit, float]:
    """The laws that take the bulk of a misfit, the fit with them, and the largest gain of a law.

    The others imitate an unlisted imperfection. A law has to gain more than a free correction of its stage still gains,
    and beside a law that gains more, also more than the corrections of all stages. The gain of a law beside others that
    have been dropped since is computed again only where it would not suffice.
    """

    def without(law: int) -> Fit:
        return refit_without(likelihood, fit, linear.laws[law].candidate)

    reduced = {law: without(law) for law in laws}
    gains, current = {law: _misfit(one) - _misfit(fit) for law, one in reduced.items()}, set(laws)
    while laws:
        largest = max(laws, key=lambda law: gains[law])
        of_all = linear.gain_of_discrepancy(laws)
        surplus = {law: gains[law] - of_all for law in laws}
        surplus[largest] = gains[largest] - linear.gain_of_discrepancy(laws, linear.laws[largest].candidate.term.stage)
        least = min(laws, key=lambda law: surplus[law])
        if surplus[least] > 0.0:
            break
        if least in current:
            laws, fit, current = tuple(law for law in laws if law != least), reduced[least], set()
        else:
            reduced[least] = without(least)
            gains[least] = _misfit(reduced[least]) - _misfit(fit)
            current.add(least)
    return laws, fit, max((gains[law] for law in laws), default=0.0)


def _misfit(fit: Fit) -> float:
    return fit.chi2 + fit.penalty


def _follows(fit: Fit) -> bool:
    """Whether a fit has the phase of the motion right in every channel."""
    return all(
        np.std(output.data - signal) < MAX_RESIDUAL_RATIO * np.std(output.data)
        for run, signals in zip(fit.model.runs, fit.model.outputs(fit.x), strict=True)
        for output, signal in zip(run.outputs, signals, strict=True)
    )


def _fit_laws(likelihood: Likelihood, fit: Fit, linear: LinearModel, laws: Sequence[int]) -> Fit:
    """The fit with these laws of the linear model and no others, from their estimates in it."""
    terms = [linear.laws[i] for i in laws]
    certain = [candidate for candidate in fit.model.candidates if not candidate.term.free_parameters]
    model = Model(fit.model.runs, fit.model.device, [*certain, *(law.candidate for law in terms)], fit.model.mains)
    estimates, others = linear.estimate(laws)
    start = fit.x.copy()
    start[common_parameters(fit)] = others
    x = model.map_parameters_from(fit.model, start)
    ends = np.cumsum([0, *(law.columns.size for law in terms)])
    for law, (low, high) in zip(terms, pairwise(ends), strict=True):
        for i, f in enumerate(model.parameters):
            if law.test is not None and f.kind == "term" and f.owner == law.candidate.key:
                x[i] = law.test.x[law.test.model.index("term", f.owner, f.name)]
        set_amplitudes(x, model, law.candidate, estimates[low:high])
    return fit_model(likelihood, model, x, max_iterations=20)
