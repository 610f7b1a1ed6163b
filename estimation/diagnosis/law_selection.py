"""Named laws that take the bulk of a misfit when no model is exactly right.

Laws are selected in the linear model around a fit, fitted, and selected again around that fit, until the selection no
longer changes. A law that gains less than a free correction beside it imitates something else and is dropped, unless
the fit without it shows that it is needed; then laws are only added to it.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from estimation.candidate_terms.discrepancy import is_discrepancy
from estimation.candidate_terms.linear_model import (
    MAX_SCALE_BESIDE,
    MIN_EXCHANGE_GAIN,
    Effects,
    Hypothesis,
    LinearModel,
    RivalFit,
)
from estimation.candidate_terms.linearisation import MAX_CHI2_RATIO, fit_terms, linear_model
from estimation.candidate_terms.screening import MAX_CHI2_GROWTH
from estimation.candidate_terms.significance import DETECTION_THRESHOLD, satisfies_sign_constraints
from estimation.device_fit.fit import Fit, Likelihood, fit_model, misfit
from estimation.device_fit.initial import refit_under_own_noise
from estimation.device_fit.parameters import Candidate
from estimation.diagnosis.necessity import NO_LAWS, Need, need_of_laws
from estimation.diagnosis.rival_laws import MAX_ALTERNATIVES, best_not_fitted, near_rivals, stated_confounders
from estimation.parallel import map_fits

MAX_LINEARISATIONS = 8
"""Fits around which laws are selected, each with the laws selected before."""


@dataclass(frozen=True)
class SelectedTerms:
    """Selected terms of a device.

    Attributes:
        likelihood: under the noise that they leave.
        nominal, fit: without them, and with them.
        rivals: other laws in the place of each, by its key.
        need: whether they are the answer beside free corrections.
        without: fits without one of several terms, by its key.
    """

    likelihood: Likelihood
    nominal: Fit
    fit: Fit
    rivals: Mapping[str, tuple[RivalFit, ...]] = field(default_factory=dict)
    need: Need = NO_LAWS
    without: Mapping[str, Fit] = field(default_factory=dict)


@dataclass(frozen=True)
class _Centre:
    """A fit around which laws are selected.

    Attributes:
        likelihood: under the noise that the fit leaves.
        fit: with any laws or a discrepancy term.
        linear: the linear model around it.
        laws: of the fit, as indices of ``linear.laws``.
    """

    likelihood: Likelihood
    fit: Fit
    linear: LinearModel
    laws: tuple[int, ...]

    @classmethod
    def around(cls, fit: Fit, candidates: Sequence[Candidate]) -> _Centre:
        """The centre at a fit that is continued under its own noise."""
        likelihood, fit = refit_under_own_noise(fit)
        linear = linear_model(likelihood, fit, candidates)
        return cls(likelihood, fit, linear, tuple(i for i, law in enumerate(linear.laws) if law.test is None))

    @property
    def effects(self) -> Effects:
        """Axis and name of the laws of the fit."""
        return self.linear.effects(self.laws)

    @cached_property
    def alone(self) -> Hypothesis:
        """The laws of the fit without a discrepancy."""
        return self.linear.without_discrepancy(self.laws)

    @cached_property
    def beside(self) -> Hypothesis:
        """The laws of the fit beside a small discrepancy."""
        return self.linear.hypothesis(self.laws, max_scale=MAX_SCALE_BESIDE)

    @property
    def leaves_noise(self) -> bool:
        """Whether corrections beside the laws of the fit gain no more than a law has to."""
        return self.alone.neg2_log_evidence - self.beside.neg2_log_evidence <= DETECTION_THRESHOLD

    def without_laws(self, nominal: Fit) -> Fit:
        """The fit of the nominal device under the likelihood of the centre."""
        return fit_model(self.likelihood, nominal.model, nominal.x)

    def takes_bulk(self, nominal: Fit) -> bool:
        """Whether the laws of the fit take the bulk of the misfit of the nominal device."""
        explained = misfit(self.without_laws(nominal)) - misfit(self.fit)
        return need_of_laws(self.linear, self.laws, explained, alone=np.inf).takes_bulk

    def is_followed_by(self, other: Fit, max_ratio: float = MAX_CHI2_RATIO) -> bool:
        """Whether another fit has possible signs and has not lost the motion, which this one has."""
        return satisfies_sign_constraints(other) and other.chi2 < max_ratio * self.fit.chi2


def choose_laws(
    anchor: Fit, nominal: Fit, candidates: Sequence[Candidate], progress: Callable[[str], None]
) -> SelectedTerms | None:
    """The named laws that take the bulk of a misfit, None where none do.

    Args:
        anchor: a fit that has the phase of the motion right, with any laws or a discrepancy term.
        nominal: the fit of the nominal device.
        candidates: named laws and discrepancy terms.
        progress: called with one line of text at every step.
    """
    end, compared = _iterate_selection(anchor, nominal, candidates, progress)
    if end is None:
        return None
    before = end.without_laws(nominal)
    alone = end.linear.hypothesis(()).neg2_log_evidence
    if any(map(is_discrepancy, anchor.model.candidates)):
        around = fit_model(end.likelihood, anchor.model, anchor.x)
        corrections = linear_model(end.likelihood, around, list(filter(is_discrepancy, candidates)))
        alone = min(alone, corrections.hypothesis(()).neg2_log_evidence)
    need = need_of_laws(end.linear, end.laws, misfit(before) - misfit(end.fit), alone)
    if not need.possible:
        return None
    linear_rivals = {end.linear.laws[i].candidate.key: end.linear.rivals(end.beside, i) for i in end.laws}
    rivals = {key: _with_fitted_rivals(key, of_law, end.fit, compared) for key, of_law in linear_rivals.items()}
    return SelectedTerms(end.likelihood, before, end.fit, rivals, need)


def _iterate_selection(
    anchor: Fit, nominal: Fit, candidates: Sequence[Candidate], progress: Callable[[str], None]
) -> tuple[_Centre | None, list[dict[Effects, Fit]]]:
    """Select laws around a fit and fit them until the selection no longer changes.

    Returns:
        where the selection ended, None where no law is selected; groups of fits that were compared under one noise.
    """
    start, fitted, centres = anchor, dict[Effects, Fit](), set[Effects]()
    compared, returned, needed = list[dict[Effects, Fit]](), False, Effects()
    for _ in range(MAX_LINEARISATIONS):
        centre = _Centre.around(start, candidates)
        linear, present = centre.linear, centre.effects
        centres.add(present)
        if returned and not centre.leaves_noise:
            return centre, compared  # several laws take parts of what no law describes
        kept = centre.laws if needed == present else ()
        proposed = [centre.laws] if returned else _propose_laws(centre, kept, first=not fitted)
        progress("fits with " + " or ".join(dict.fromkeys(map(linear.describe, proposed))))
        options = {linear.effects(laws): laws for laws in proposed if laws}
        if not options:
            if not present or needed == present or not _is_needed(centre, centre.without_laws(nominal)):
                break
            needed, start = present, centre.fit
            continue
        if list(options) == [present]:
            progress(f"laws that are hard to tell from {linear.describe(centre.laws)}")
            exchanged, near = _exchange_near_rival(centre, candidates, fitted, nominal)
            compared.append(near)
            if exchanged is None:
                return centre, compared
            start = exchanged
            continue
        fits = _fit_sets(centre, options, fitted)
        if not fitted and present:
            fits[present] = centre.fit
        fits = {effects: fit for effects, fit in fits.items() if centre.is_followed_by(fit)}
        if _addition_failed(centre, options, fits, nominal):
            more = _fit_sets(centre, _further_additions(centre, fitted.keys() | options.keys()), fitted)
            fits |= {effects: fit for effects, fit in more.items() if centre.is_followed_by(fit)}
        if not fits:
            return centre if present else None, compared
        compared.append({present: centre.fit, **fits} if present else fits)
        effects = min(fits, key=lambda names: fits[names].neg2_log_evidence)
        best = fits[effects]
        if effects == present or (effects < present and _is_needed(centre, best)):
            needed = present
            fitted[needed] = start = centre.fit
            continue
        returned, is_worse = effects in centres, best.neg2_log_evidence > centre.fit.neg2_log_evidence
        if present and is_worse and (returned or len(effects) > len(present)):
            if not centre.leaves_noise:
                return centre, compared
            returned, start = True, centre.fit
            continue
        fitted[effects] = start = best
    return None, compared


def _propose_laws(centre: _Centre, kept: tuple[int, ...], first: bool) -> list[tuple[int, ...]]:
    """Sets of laws to be fitted, selected in the linear model around a fit.

    Args:
        kept: laws of the fit, where they are known to be needed.
        first: whether no selected laws have been fitted.
    """
    linear = centre.linear
    if not first:
        return [linear.select(centre.laws, max_moves=1, kept=kept).laws]
    if any(map(is_discrepancy, centre.fit.model.candidates)):
        alone = linear.strongest(MAX_ALTERNATIVES)
    elif len({axis for axis, _ in centre.effects}) > 1:  # each alone leaves the other axis as it is
        alone = linear.strongest(len(centre.laws))
    else:
        alone = [(law,) for law in centre.laws]
    return [linear.select().laws, linear.strongest_together(), *alone]


def _addition_failed(centre: _Centre, options: Collection[Effects], fits: Mapping[Effects, Fit], nominal: Fit) -> bool:
    """Whether laws were added to those of a fit in vain, so that other ones may be added.

    The new fits are not possible, or not better while the laws so far leave much.
    """
    if not all(centre.effects and centre.effects < effects for effects in options):
        return False
    is_better = any(fit.neg2_log_evidence <= centre.fit.neg2_log_evidence for fit in fits.values())
    return not fits or not (is_better or centre.takes_bulk(nominal))


def _further_additions(centre: _Centre, fitted: Collection[Effects]) -> dict[Effects, tuple[int, ...]]:
    """The laws of a fit with one more that has not been fitted, up to ``MAX_ALTERNATIVES``.

    They are tried where the sensitivities of the one that the linear model proposed were wrong.
    """
    linear = centre.linear
    more = [(*centre.laws, i) for i in range(len(linear.laws)) if not linear.effects([i]) & centre.effects]
    return best_not_fitted(linear, more, fitted)


def _fit_sets(
    centre: _Centre,
    sets: Mapping[Effects, tuple[int, ...]],
    fitted: Mapping[Effects, Fit],
    max_ratio: float = MAX_CHI2_RATIO,
) -> dict[Effects, Fit]:
    """Fits of sets of laws, each from an earlier one of the same effects where there is one."""

    def fit(laws: tuple[int, ...]) -> Fit:
        earlier = fitted.get(centre.linear.effects(laws))
        if earlier is not None:
            return fit_model(centre.likelihood, earlier.model, earlier.x)
        terms = [centre.linear.laws[i] for i in laws]
        return fit_terms(centre.linear, centre.likelihood, centre.fit, terms, max_ratio)

    return dict(zip(sets, map_fits(fit, sets.values(), centre.likelihood.steps), strict=True))


def _is_needed(centre: _Centre, reduced: Fit) -> bool:
    """Whether the misfit without some laws is higher by more than corrections beside all of them take.

    The linear model removes a law whose part corrections or other laws seem to take; far from the fit without that law
    it may be wrong.

    Args:
        reduced: fit with some of the laws of the centre.
    """
    return misfit(reduced) - misfit(centre.fit) > centre.linear.gain_of_discrepancy(centre.laws)


def _with_fitted_rivals(
    key: str, rivals: tuple[RivalFit, ...], fit: Fit, compared: Sequence[dict[Effects, Fit]]
) -> tuple[RivalFit, ...]:
    """Rivals of a law, and laws that were fitted in its place, with the smaller gap.

    The linear model around one law may be wrong by more than two laws differ: a law whose fit under the same noise is
    as good is as probable. Two laws that were fitted under different noise are compared through a third one, which was
    fitted under both.

    Args:
        key: of the law.
        compared: fits that were compared with each other, the last group under the noise of ``fit``.
    """
    laws = _keys(fit)
    gaps = {laws: (0.0, 0.0)}
    for fits in reversed(compared):
        scores = {_keys(one): np.array([one.neg2_log_evidence, misfit(one)]) for one in fits.values()}
        common = next((each for each in gaps if each in scores), None)
        if common is not None:
            gaps |= {k: tuple(gaps[common] + scores[k] - scores[common]) for k in scores if k not in gaps}
    candidates = {c.key: c for fits in compared for one in fits.values() for c in one.model.candidates}
    best = {rival.candidate.key: rival for rival in rivals}
    for others, (gap, misfit_gap) in gaps.items():
        new = others - laws
        if len(new) != 1 or others - new != laws - {key}:
            continue
        (name,) = new
        if name not in best or gap < best[name].evidence_gap:
            best[name] = RivalFit(max(float(gap), 0.0), candidates[name], float(misfit_gap))
    return tuple(sorted(best.values(), key=lambda rival: rival.evidence_gap))


def _keys(fit: Fit) -> frozenset[str]:
    return frozenset(candidate.key for candidate in fit.model.candidates)


def _exchange_near_rival(
    centre: _Centre, candidates: Sequence[Candidate], fitted: dict[Effects, Fit], nominal: Fit
) -> tuple[Fit | None, dict[Effects, Fit]]:
    """The fit with one law exchanged that has a better evidence around itself; None where there is none.

    Sensitivities of a law far from its own fit may be wrong by more than near rivals differ: those within
    ``DETECTION_THRESHOLD`` are fitted, each once, the best in the place of every law first, and compared around their
    own fits, unless a rival leaves so much more that the linear model, which predicts the same for it, is wrong. Where
    the laws take the bulk of a misfit, so are the confounders that their terms state; laws that take a part of what no
    law describes have none. Where corrections gain no more than that beside the laws, they have no part in the
    comparison: beside a fit that leaves only noise, one that leaves more to corrections is not a better one.

    Returns:
        that fit, and all fits that were compared under the same noise.
    """
    discrepancies = [] if centre.leaves_noise else list(filter(is_discrepancy, candidates))
    present = centre.alone if centre.leaves_noise else centre.beside
    best, lowest = None, present.neg2_log_evidence - MIN_EXCHANGE_GAIN
    near = near_rivals(centre.linear, centre.beside, fitted)
    if centre.leaves_noise or centre.takes_bulk(nominal):
        near |= stated_confounders(centre.linear, centre.laws, fitted.keys() | near.keys())
    rivals = _fit_sets(centre, near, fitted, MAX_CHI2_GROWTH)
    fitted |= rivals
    compared = {effects: fit for effects, fit in rivals.items() if centre.is_followed_by(fit, MAX_CHI2_GROWTH)}
    for fit in compared.values():
        around = linear_model(centre.likelihood, fit, discrepancies)
        laws = range(len(around.laws))
        score = around.hypothesis(tuple(laws), max_scale=MAX_SCALE_BESIDE).neg2_log_evidence
        if score < lowest:
            best, lowest = fit, score
    return best, {centre.effects: centre.fit, **compared}
