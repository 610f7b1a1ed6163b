"""Named laws that take the bulk of a misfit when no model is exactly right.

Laws are selected in the linear model around a fit, fitted, and selected again around that fit, until the selection no
longer changes. A law that gains less than a free correction beside it imitates something else and is dropped, unless
the fit without it shows that it is needed; then laws are only added to it.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import NamedTuple

from estimation.device_fit.fit import Fit, Likelihood, fit_model, misfit
from estimation.device_fit.initial import estimate_whiteners
from estimation.device_fit.parameters import Candidate
from estimation.diagnosis.discrepancy import is_discrepancy
from estimation.diagnosis.linear_model import (
    MAX_SCALE_BESIDE,
    MIN_EXCHANGE_GAIN,
    MIN_SCORE_GAIN,
    Effects,
    Hypothesis,
    LinearModel,
    RivalFit,
)
from estimation.diagnosis.linearisation import MAX_CHI2_RATIO, fit_laws, linear_model
from estimation.diagnosis.necessity import Need, need_of_laws
from estimation.diagnosis.significance import satisfies_sign_constraints
from estimation.parallel import map_fits

MAX_LINEARISATIONS = 8
"""Fits around which laws are selected, each with the laws selected before."""

MAX_ALTERNATIVES = 6
"""Laws that are fitted in the place of each other, the best in the linear model: single laws around a discrepancy, as
sensitivities do not rank them well, and near rivals of selected laws. Each costs a fit."""


class Choice(NamedTuple):
    """Named laws that explain a recording but for a small remainder.

    Attributes:
        likelihood: under the noise that they leave.
        before, fit: of the nominal device, and of the device with them.
        rivals: other laws in the place of each, by its key.
        need: whether they are the answer beside free corrections.
    """

    likelihood: Likelihood
    before: Fit
    fit: Fit
    rivals: dict[str, tuple[RivalFit, ...]]
    need: Need


class _Selection(NamedTuple):
    """Where the selection ended.

    Attributes:
        likelihood: under the noise that the fit leaves.
        linear: the linear model around the fit.
        fit: with the selected laws.
        compared: groups of fits that were compared under the same noise.
    """

    likelihood: Likelihood
    linear: LinearModel
    fit: Fit
    compared: list[dict[Effects, Fit]]


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
    end = _iterate_selection(anchor, candidates, progress)
    if end is None:
        return None
    likelihood, linear, fit = end.likelihood, end.linear, end.fit
    present = _present_laws(linear)
    before = fit_model(likelihood, nominal.model, nominal.x)
    alone = linear.hypothesis(()).neg2_log_evidence
    if any(map(is_discrepancy, anchor.model.candidates)):
        alone = min(alone, _evidence_of_discrepancy(likelihood, anchor, candidates))
    need = need_of_laws(linear, present, misfit(before) - misfit(fit), alone)
    if not need.possible:
        return None
    hypothesis = linear.hypothesis(present, max_scale=MAX_SCALE_BESIDE)
    linear_rivals = {linear.laws[i].candidate.key: linear.rivals(hypothesis, i) for i in present}
    rivals = {key: _with_fitted_rivals(key, of_law, fit, end.compared) for key, of_law in linear_rivals.items()}
    return Choice(likelihood, before, fit, rivals, need)


def _iterate_selection(
    anchor: Fit, candidates: Sequence[Candidate], progress: Callable[[str], None]
) -> _Selection | None:
    """Select laws around a fit and fit them until the selection no longer changes; None where no law is selected."""
    fit, fitted, centres = anchor, dict[Effects, Fit](), set[Effects]()
    compared, returned, needed = list[dict[Effects, Fit]](), False, Effects()
    for _ in range(MAX_LINEARISATIONS):
        likelihood = Likelihood(fit.model.runs, estimate_whiteners(fit.model, fit.x))
        fit = fit_model(likelihood, fit.model, fit.x)
        linear = linear_model(likelihood, fit, candidates)
        present = _present_laws(linear)
        centres.add(linear.effects(present))
        if returned and not _leaves_noise(
            linear.without_discrepancy(present), linear.hypothesis(present, max_scale=MAX_SCALE_BESIDE)
        ):
            break  # several laws take parts of what no law describes
        kept = present if needed == linear.effects(present) else ()
        proposed = [present] if returned else _propose_laws(linear, fit, kept, first=not fitted)
        progress("beside a discrepancy: " + " or ".join(map(linear.describe, proposed)))
        options = {linear.effects(laws): laws for laws in proposed if laws}
        if not options:
            return None
        if list(options) != [linear.effects(present)]:
            fits = _fit_options(linear, likelihood, fit, options, fitted)
            if not fits and present:
                break
            if not fits:
                return None
            compared.append(fits)
            effects = min(fits, key=lambda names: fits[names].neg2_log_evidence)
            with_laws = fits[effects]
            removes = effects < linear.effects(present)
            if effects == linear.effects(present) or (removes and _is_needed(linear, present, fit, with_laws)):
                needed = linear.effects(present)
                fitted[needed] = fit
                continue
            returned, is_worse = effects in centres, with_laws.neg2_log_evidence > fit.neg2_log_evidence
            if present and is_worse and (returned or len(effects) > len(present)):
                break
            fitted[effects] = fit = with_laws
            continue
        exchanged, near = _exchange_near_rival(linear, likelihood, fit, present, candidates, fitted)
        compared.append(near)
        if exchanged is None:
            break
        fit = exchanged
    else:
        return None
    return _Selection(likelihood, linear, fit, compared)


def _present_laws(linear: LinearModel) -> tuple[int, ...]:
    """Laws of the fit around which a model is linear."""
    return tuple(i for i, law in enumerate(linear.laws) if law.test is None)


def _leaves_noise(alone: Hypothesis, beside: Hypothesis) -> bool:
    """Whether corrections gain no more than a law has to: ``beside`` laws that are also compared ``alone``."""
    return alone.neg2_log_evidence - beside.neg2_log_evidence <= MIN_SCORE_GAIN


def _propose_laws(linear: LinearModel, fit: Fit, kept: tuple[int, ...], first: bool) -> list[tuple[int, ...]]:
    """Sets of laws to be fitted, selected in the linear model around a fit.

    Args:
        kept: laws of the fit, where they are known to be needed.
        first: whether no selected laws have been fitted.
    """
    present = _present_laws(linear)
    if not first:
        return [linear.select(present, max_moves=1, kept=kept).laws]
    if any(map(is_discrepancy, fit.model.candidates)):
        alone = linear.strongest(MAX_ALTERNATIVES)
    elif len({axis for axis, _ in linear.effects(present)}) > 1:  # each alone leaves the other axis as it is
        alone = linear.strongest(len(present))
    else:
        alone = [(law,) for law in present]
    return [linear.select().laws, linear.strongest_together(), *alone]


def _fit_options(
    linear: LinearModel,
    likelihood: Likelihood,
    fit: Fit,
    options: dict[Effects, tuple[int, ...]],
    fitted: dict[Effects, Fit],
) -> dict[Effects, Fit]:
    """Fits of selected laws, and at first the one around which they were selected, that follow the recording."""
    of_laws = map_fits(lambda laws: fit_laws(linear, likelihood, fit, laws, fitted), options.values(), likelihood.steps)
    fits = dict(zip(options, of_laws, strict=True))
    present = _present_laws(linear)
    if not fitted and present:
        fits[linear.effects(present)] = fit
    limit = MAX_CHI2_RATIO * fit.chi2
    return {effects: one for effects, one in fits.items() if satisfies_sign_constraints(one) and one.chi2 < limit}


def _is_needed(linear: LinearModel, present: tuple[int, ...], fit: Fit, reduced: Fit) -> bool:
    """Whether the misfit without some laws is higher by more than corrections beside all of them take.

    The linear model removes a law whose part corrections or other laws seem to take; far from the fit without that law
    it may be wrong.

    Args:
        linear: around ``fit``.
        present: its laws.
        fit, reduced: with all of these laws, and without some.
    """
    return misfit(reduced) - misfit(fit) > linear.gain_of_discrepancy(present)


def _with_fitted_rivals(
    key: str, rivals: tuple[RivalFit, ...], fit: Fit, compared: Sequence[dict[Effects, Fit]]
) -> tuple[RivalFit, ...]:
    """Rivals of a law, and laws that were fitted in its place, with the smaller gap.

    The linear model around one law may be wrong by more than two laws differ: a law whose fit under the same noise is
    as good is as probable.

    Args:
        key: of the law.
        compared: fits that were compared with each other.
    """
    laws = {candidate.key: candidate for candidate in fit.model.candidates}
    best = {rival.candidate.key: rival for rival in rivals}
    for fits in compared:
        own = next((one for one in fits.values() if {c.key for c in one.model.candidates} == laws.keys()), None)
        if own is None:
            continue
        for other in fits.values():
            new = [candidate for candidate in other.model.candidates if candidate.key not in laws]
            if len(new) != 1 or {c.key for c in other.model.candidates} - {new[0].key} != laws.keys() - {key}:
                continue
            gap = max(other.neg2_log_evidence - own.neg2_log_evidence, 0.0)
            if new[0].key not in best or gap < best[new[0].key].evidence_gap:
                best[new[0].key] = RivalFit(gap, new[0], misfit(other) - misfit(own))
    return tuple(sorted(best.values(), key=lambda rival: rival.evidence_gap))


def _evidence_of_discrepancy(likelihood: Likelihood, anchor: Fit, candidates: Sequence[Candidate]) -> float:
    """-2 log evidence of discrepancies of all stages around the fit of one."""
    fit = fit_model(likelihood, anchor.model, anchor.x)
    around = linear_model(likelihood, fit, list(filter(is_discrepancy, candidates)))
    return around.hypothesis(()).neg2_log_evidence


def _exchange_near_rival(
    linear: LinearModel,
    likelihood: Likelihood,
    fit: Fit,
    present: tuple[int, ...],
    candidates: Sequence[Candidate],
    fitted: dict[Effects, Fit],
) -> tuple[Fit | None, dict[Effects, Fit]]:
    """The fit with one law exchanged that has a better evidence around itself; None where there is none.

    Sensitivities of a law far from its own fit may be wrong by more than near rivals differ: those within
    ``MIN_SCORE_GAIN`` are fitted, each once, the best in the place of every law first, and compared around their own
    fits. Where corrections gain no more than that beside the laws, they have no part in the comparison: beside a fit
    that leaves only noise, one that leaves more to corrections is not a better one.

    Returns:
        that fit, and all fits that were compared under the same noise.
    """
    hypothesis = linear.hypothesis(present, max_scale=MAX_SCALE_BESIDE)
    alone = linear.without_discrepancy(present)
    leaves_noise = _leaves_noise(alone, hypothesis)
    discrepancies = [] if leaves_noise else list(filter(is_discrepancy, candidates))
    best, lowest = None, (alone if leaves_noise else hypothesis).neg2_log_evidence - MIN_EXCHANGE_GAIN
    compared = {linear.effects(present): fit}
    rivals = _near_rivals(linear, hypothesis, fitted)
    fits = map_fits(lambda laws: fit_laws(linear, likelihood, fit, laws, fitted), rivals.values(), likelihood.steps)
    for effects, other in zip(rivals, fits, strict=True):
        fitted[effects] = other
        if not satisfies_sign_constraints(other) or other.chi2 > MAX_CHI2_RATIO * fit.chi2:
            continue
        compared[effects] = other
        around = linear_model(likelihood, other, discrepancies)
        laws = range(len(around.laws))
        score = around.hypothesis(tuple(laws), max_scale=MAX_SCALE_BESIDE).neg2_log_evidence
        if score < lowest:
            best, lowest = other, score
    return best, compared


def _near_rivals(
    linear: LinearModel, hypothesis: Hypothesis, fitted: Collection[Effects]
) -> dict[Effects, tuple[int, ...]]:
    """Laws with one exchanged that are within ``MIN_SCORE_GAIN`` of a hypothesis and have not been fitted.

    The first are the best ones in the place of every law, then the second ones, up to ``MAX_ALTERNATIVES``.
    """
    ranked: list[tuple[int, float, tuple[int, ...]]] = []
    for removed in hypothesis.laws:
        rest = tuple(law for law in hypothesis.laws if law != removed)
        best: dict[Effects, Hypothesis] = {}
        for rival in sorted(linear.beside(rest, hypothesis.scales), key=lambda one: one.neg2_log_evidence):
            if rival.neg2_log_evidence < hypothesis.neg2_log_evidence + MIN_SCORE_GAIN:
                best.setdefault(linear.effects(rival.laws), rival)
        new = [rival for effects, rival in best.items() if effects not in fitted]
        ranked += [(rank, rival.neg2_log_evidence, rival.laws) for rank, rival in enumerate(new)]
    return {linear.effects(laws): laws for _, _, laws in sorted(ranked)[:MAX_ALTERNATIVES]}
