"""Stepwise selection of terms by evidence: nominal model, noise, one term after the other, joint refit."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from estimation.diagnosis.clipping import clipped_readouts
from estimation.diagnosis.data import Run
from estimation.diagnosis.discrepancy import DISCREPANCY_TERMS
from estimation.diagnosis.exchange import RivalFit, RivalFits, exchange_to_convergence, fit_exchanges, rivals_of
from estimation.diagnosis.fit import Fit, Likelihood, fit_model, fit_models
from estimation.diagnosis.initial import (
    estimate_whiteners,
    fit_initial_state,
    fit_progressively,
    flat_whiteners,
    window_schedule,
)
from estimation.diagnosis.interference import strongest_interfering_line
from estimation.diagnosis.law_selection import choose_laws
from estimation.diagnosis.model import MAINS_HZ, Candidate, Model, uncertain
from estimation.diagnosis.noise import Whitener
from estimation.diagnosis.progressive_fit import (
    CHI2_ADEQUATE,
    CHI2_LINEARISABLE,
    fit_candidates_progressively,
    fit_screened_candidates,
)
from estimation.diagnosis.pruning import prune_by_evidence
from estimation.diagnosis.screening import all_candidates
from estimation.diagnosis.significance import (
    DETECTION_THRESHOLD,
    UNIQUE_NAME_THRESHOLD,
    evidence_gain,
    is_significant,
    satisfies_sign_constraints,
)
from scanner.device import Device
from scanner.terms import Term

Progress = Callable[[str], None]
"""Called with one line of text at every step."""

MAX_EFFECTS = 3
"""Effects that are selected in one diagnosis. It bounds the cost: each effect needs a search among all candidates."""

CHI2_LARGE = 10.0
"""Held-out reduced chi-square of the nominal device above which several named terms may replace a discrepancy term.
With a smaller misfit, three terms can explain nearly anything."""

MAX_REMAINING_MISFIT_RATIO = 0.005
"""Largest ratio of the remaining to the nominal misfit with which several named terms replace a discrepancy term. It
corresponds to 7 % of the amplitude of the misfit."""

CHI2_INADEQUATE = 1.3
"""Held-out reduced chi-square above which named terms do not explain the data; probably confounders of the true effect
were selected."""

CHI2_DIVERGED = 100.0
"""Reduced chi-square above which the phase error of a fit exceeds half a cycle, so that sensitivities around it do not
predict the effect of a further term."""

MAX_DISCREPANCY_FITS = 3
"""Number of discrepancy terms that are pruned and compared with named terms. Each costs a fit."""

REFIT_MARGIN, REFIT_MARGIN_RELATIVE = 80.0, 0.1
"""Candidates up to this distance from the best in -2 log evidence, or up to this share of the gain of the best, are
refitted after the noise has been estimated again, because that may change their order."""


@dataclass(frozen=True)
class SelectionStep:
    """One selected term, the fits without and with it, and its rivals.

    Attributes:
        candidate: the term.
        before, after: fits without and with the term. Both contain all other selected terms and use the same noise.
        rivals: terms that were fitted instead of it.
    """

    candidate: Candidate
    before: Fit
    after: Fit
    rivals: RivalFits


@dataclass(frozen=True)
class SelectionResult:
    """Result of the selection.

    Attributes:
        likelihood: of the recordings, with the noise spectrum of the last estimate.
        nominal: fit of the nominal device under that likelihood.
        final: fit of the device with all selected terms.
        steps: one for each selected term.
    """

    likelihood: Likelihood
    nominal: Fit
    final: Fit
    steps: tuple[SelectionStep, ...] = field(default_factory=tuple)


def select_terms(
    runs: Sequence[Run], device: Device, terms: Mapping[str, Term], progress: Progress = lambda text: None
) -> SelectionResult:
    """Select the terms that ``device`` omits from ``runs``.

    Where a discrepancy term fits better than any single term but not adequately, several terms may act. They are
    selected if, added one after the other, they leave almost no misfit and have the better evidence.

    Args:
        terms: candidates by effect.
        progress: called with one line of text at every step.
    """
    clipped = clipped_readouts(runs, terms.get("saturation"))
    model = Model(runs, device, clipped)
    progress("nominal device")
    stops = window_schedule(model)
    likelihood = Likelihood(runs, flat_whiteners(model))
    early = fit_progressively(likelihood, model, fit_initial_state(likelihood, model, stops[0]).x, stops)
    likelihood = Likelihood(runs, _min_entropy_whiteners(_fit_hum_variants(likelihood, early[-1])))
    nominal = fit_model(likelihood, model, early[-1].x)
    named = [each for each in terms.values() if each.effect not in {certain.term.effect for certain in clipped}]
    states = [SelectionState(likelihood, nominal, select_mains_hum(likelihood, nominal), {})]
    states += _forward_steps(states[0], [*named, *DISCREPANCY_TERMS.values()], early, stops, progress)
    found = states[-1]
    if not found.settled and len(uncertain(found.best.model)) > 1:
        pool = all_candidates(device, found.best.model, [*named, *DISCREPANCY_TERMS.values()])
        chosen = _LawChoice(found.nominal, pool, found.rivals, progress)
        if chosen.settles(found.best) and chosen.state is not None:
            found = chosen.state
    if (
        _ends_with_discrepancy(found.best)
        and found.nominal.validation_chi2 > CHI2_LARGE
        and found.best.validation_chi2 > CHI2_ADEQUATE
    ):
        several = _accept_while_halving(
            states[-2], _forward_steps(states[-2], named, early, stops, progress, found.tried)
        )
        enough = several.best.validation_chi2 - 1.0 < MAX_REMAINING_MISFIT_RATIO * (
            several.nominal.validation_chi2 - 1.0
        )
        if (
            enough
            and fit_model(found.likelihood, several.best.model, several.best.x).neg2_log_evidence
            < found.best.neg2_log_evidence
        ):
            found = several
    if _ends_with_discrepancy(found.best):
        # with the required amplitudes only, its law is simpler and better determined
        fewer = prune_by_evidence(found.likelihood, found.best)
        if fewer is not None and fewer.neg2_log_evidence < found.best.neg2_log_evidence:
            found = replace(found, best=fewer)
    elif len(found.best.model.candidates) > len(clipped) and not found.settled:
        found = _replace_terms_by_discrepancy(found)
    steps = tuple(
        _selection_step(found.likelihood, found.nominal, found.best, each, found.rivals.get(each.key, ()))
        for each in found.best.model.candidates
    )
    return SelectionResult(found.likelihood, found.nominal, found.best, steps)


@dataclass(frozen=True)
class SelectionState:
    """State of the selection.

    Attributes:
        nominal, best: the nominal device and the best fit, under the same noise.
        rivals: of each term, by its key.
        tried: fits of the named terms among which the last was chosen, under the noise before it.
        settled: whether the terms were chosen beside a discrepancy, so that none may replace them.
    """

    likelihood: Likelihood
    nominal: Fit
    best: Fit
    rivals: Mapping[str, RivalFits]
    tried: Sequence[Fit] = ()
    settled: bool = False


def _forward_steps(
    state: SelectionState,
    terms: Sequence[Term],
    early: Sequence[Fit],
    stops: Sequence[float],
    progress: Progress,
    tried: Sequence[Fit] = (),
) -> Iterator[SelectionState]:
    """States of the selection after each added term.

    Args:
        tried: fits of the candidates of the first step, if they exist already.
    """
    likelihood, nominal, best, rivals = state.likelihood, state.nominal, state.best, dict(state.rivals)
    for _ in range(MAX_EFFECTS - len(best.model.candidates)):
        taken = {each.key for each in best.model.candidates}
        if taken:
            # The noise was estimated before these terms were fitted, so it may contain part of their effect.
            likelihood = Likelihood(best.model.runs, estimate_whiteners(best.model, best.x))
            best = fit_model(likelihood, best.model, best.x)
        best = with_interference_line(likelihood, best)
        adequate = bool(rivals) and best.validation_chi2 < CHI2_ADEQUATE
        pool = [each for each in terms if not (adequate and each.effect in DISCREPANCY_TERMS)]
        candidates = [each for each in all_candidates(best.model.device, best.model, pool) if each.key not in taken]
        progress(f"{len(candidates)} candidates" + (f" beside {', '.join(sorted(taken))}" if taken else ""))
        chosen = _LawChoice(nominal, candidates, rivals, progress)
        if tried:
            fits, tried = list(tried), ()
        elif best.chi2 < (CHI2_DIVERGED if taken else CHI2_LINEARISABLE) * best.rows.sum():
            fits = fit_screened_candidates(likelihood, best, candidates, chosen.settles)
        else:
            if taken:
                progress(f"refitting windows with {', '.join(sorted(taken))}")
                early = fit_progressively(
                    likelihood, best.model, best.model.map_parameters_from(early[0].model, early[0].x), stops
                )
            fits = fit_candidates_progressively(likelihood, best.model, early, stops, candidates, chosen.settles)
        if chosen.state is not None:
            yield chosen.state
            return
        if not fits or best.neg2_log_evidence - fits[0].neg2_log_evidence < DETECTION_THRESHOLD:
            return
        progress(f"refit with {fits[0].model.candidates[-1].key}")
        likelihood = Likelihood(best.model.runs, estimate_whiteners(fits[0].model, fits[0].x))
        by_name = [fit for fit in fits if not _ends_with_discrepancy(fit)]
        reach = max(REFIT_MARGIN, REFIT_MARGIN_RELATIVE * (best.neg2_log_evidence - fits[0].neg2_log_evidence))
        close = [fit for fit in fits if fit.neg2_log_evidence < fits[0].neg2_log_evidence + reach][:6]
        close = fit_models(likelihood, [(fit.model, fit.x) for fit in close])
        close = sorted((fit for fit in close if satisfies_sign_constraints(fit)), key=lambda fit: fit.neg2_log_evidence)
        before = fit_model(likelihood, best.model, best.x, max_iterations=4)
        nominal = before if not rivals else fit_model(likelihood, nominal.model, nominal.x, max_iterations=4)
        found = next((fit for fit in close if is_significant(likelihood, before, fit)), None)
        if found is None and before.validation_chi2 > CHI2_INADEQUATE and not taken:
            found = next(
                (fit for fit in close if _ends_with_discrepancy(fit)), None
            )  # an effect is missing, of which only the stage is known
        if found is None:
            yield SelectionState(likelihood, nominal, before, rivals, by_name)
            return
        named = [each for each in candidates if each.term.effect not in DISCREPANCY_TERMS]
        leads = _rivals_of_newest(found, before, close)
        if _ends_with_discrepancy(found):
            progress("named laws beside the discrepancy")
            if chosen.settles(found) and chosen.state is not None:
                yield chosen.state
                return
            likelihood, before, found = _replace_discrepancy_by_terms(likelihood, before, found, named)
            close = []  # they were fitted under another noise if terms were exchanged
        if not _ends_with_discrepancy(found) and found.chi2 < CHI2_DIVERGED * found.rows.sum():
            # The first term may imitate several effects: where much misfit remains, it may be exchanged too.
            kept = len(best.model.candidates) if found.validation_chi2 <= CHI2_LINEARISABLE else 0
            newest = min(len(found.model.candidates) - kept, len(uncertain(found.model)))
            final = exchange_to_convergence(likelihood, found, named, newest)
            earlier = _rivals_of_newest(final.fit, before, close)
            leads = {key: _merge_rivals(own, earlier.get(key, ())) for key, own in final.rivals.items()}
            found = final.fit
        rivals |= leads
        best = drop_redundant(likelihood, found)
        yield SelectionState(likelihood, nominal, best, rivals, by_name)
        if _ends_with_discrepancy(best):
            return


class _LawChoice:
    """Whether named laws with a small remainder explain the misfit, decided once the best named term is fitted.

    Attributes:
        state: with the laws, under the noise that they leave; None where they do not.
    """

    def __init__(
        self, nominal: Fit, candidates: Sequence[Candidate], rivals: Mapping[str, RivalFits], progress: Progress
    ):
        self._nominal, self._candidates, self._rivals, self._progress = nominal, candidates, rivals, progress
        self.state: SelectionState | None = None

    def settles(self, best: Fit) -> bool:
        """Whether no discrepancy term has to be fitted beside the best named term.

        Where the nominal device is nearly adequate, the laws also have to be significant without a discrepancy. A law
        that slow noise explains as well is dropped.
        """
        choice = choose_laws(best, self._candidates, self._progress)
        if choice is None or not satisfies_sign_constraints(choice.fit):
            return False
        several = len(uncertain(choice.fit.model)) > 1
        fit = drop_redundant(choice.likelihood, choice.fit) if several else choice.fit
        before = fit_model(choice.likelihood, self._nominal.model, self._nominal.x)
        if before.validation_chi2 < CHI2_INADEQUATE and not is_significant(choice.likelihood, before, fit):
            return False
        rivals = {**self._rivals, **choice.rivals}
        self.state = SelectionState(choice.likelihood, before, fit, rivals, settled=True)
        return True


def _accept_while_halving(start: SelectionState, further: Iterator[SelectionState]) -> SelectionState:
    """The last of ``further`` while each at least halves the misfit of the one before it."""
    last = start
    for state in further:
        worth = state.best.validation_chi2 - 1.0 < 0.5 * (last.best.validation_chi2 - 1.0)
        last = state
        if not worth:
            break
    return last


def _replace_discrepancy_by_terms(
    likelihood: Likelihood, before: Fit, free: Fit, named: Sequence[Candidate]
) -> tuple[Likelihood, Fit, Fit]:
    """Replace a discrepancy term by named terms if they have the better evidence, under newly estimated noise.

    Returns:
        likelihood, the fit before, the fit with the terms or, where none is adequate, with the discrepancy term.
    """
    others = fit_exchanges(likelihood, free, free.model.candidates[-1:], named, pairs=True)
    others = [
        fit
        for fit in others
        if fit.neg2_log_evidence < free.neg2_log_evidence and is_significant(likelihood, before, fit)
    ]
    if not others:
        return likelihood, before, free
    found = others[0]
    fewer = [fit for fit in others if len(fit.model.candidates) < len(found.model.candidates)]
    # the second of two terms must be significant like any second effect
    if fewer and not is_significant(likelihood, fewer[0], found):
        found = fewer[0]
    likelihood = Likelihood(likelihood.runs, estimate_whiteners(found.model, found.x))
    return likelihood, fit_model(likelihood, before.model, before.x), fit_model(likelihood, found.model, found.x)


def _replace_terms_by_discrepancy(state: SelectionState) -> SelectionState:
    """Replace named terms by one pruned discrepancy term if that lowers -2 log evidence by ``UNIQUE_NAME_THRESHOLD``.

    All terms of one stage are replaced: they may be the first terms of the series of one law without a name, which can
    be fitted only around a model that has the phase right. With a single term per stage, the most important term is
    replaced if the fit is inadequate. The replaced terms are reported as rivals. Otherwise the state is unchanged.
    """
    likelihood, fit = state.likelihood, state.best
    terms = uncertain(fit.model)
    removed = max(([each for each in terms if each.term.stage == first.term.stage] for first in terms), key=len)
    if len(removed) == 1:
        if fit.validation_chi2 < CHI2_INADEQUATE:
            return state
        removed = [max(terms, key=lambda each: refit_without(likelihood, fit, each).neg2_log_evidence)]
    free = all_candidates(fit.model.device, fit.model, DISCREPANCY_TERMS.values())
    others = [each for each in fit_exchanges(likelihood, fit, removed, free) if each.chi2 < fit.chi2]
    fewer = [
        each
        for each in (prune_by_evidence(likelihood, other) for other in others[:MAX_DISCREPANCY_FITS])
        if each is not None
    ]
    best = min(fewer, key=lambda each: each.neg2_log_evidence, default=fit)
    if best.neg2_log_evidence > fit.neg2_log_evidence - UNIQUE_NAME_THRESHOLD:
        return state
    found = drop_redundant(likelihood, best)
    worse = fit.chi2 + fit.penalty - best.chi2 - best.penalty
    leads = tuple(RivalFit(fit.neg2_log_evidence - best.neg2_log_evidence, each, worse) for each in removed)
    return replace(state, best=found, rivals={**state.rivals, found.model.candidates[-1].key: leads})


def _rivals_of_newest(found: Fit, before: Fit, tried: Sequence[Fit]) -> dict[str, RivalFits]:
    """Rivals, among ``tried``, of the one term that ``found`` has in addition to ``before``."""
    old = {candidate.key for candidate in before.model.candidates}
    new = [candidate.key for candidate in found.model.candidates if candidate.key not in old]
    less_likely = [
        fit
        for fit in tried
        if fit.neg2_log_evidence > found.neg2_log_evidence and fit.model.candidates[-1].key not in new
    ]
    return {new[0]: rivals_of(found, less_likely)} if len(new) == 1 else {}


def _merge_rivals(*parts: RivalFits) -> RivalFits:
    """All rivals with their smallest gaps, sorted by evidence."""
    nearest: dict[str, RivalFit] = {}
    for rival in (entry for part in parts for entry in part):
        previous = nearest.setdefault(rival.candidate.key, rival)
        nearest[rival.candidate.key] = RivalFit(
            min(previous.evidence_gap, rival.evidence_gap), rival.candidate, min(previous.misfit_gap, rival.misfit_gap)
        )
    return tuple(sorted(nearest.values(), key=lambda entry: entry.evidence_gap))


def _ends_with_discrepancy(fit: Fit) -> bool:
    return bool(fit.model.candidates) and fit.model.candidates[-1].term.effect in DISCREPANCY_TERMS


def drop_redundant(likelihood: Likelihood, fit: Fit) -> Fit:
    """Refit without the terms that the others make redundant.

    A confounder may be selected first and become redundant when the true effect is added. Hum is selected again with
    and without every term, because in a short recording a drift and one mains frequency resemble the other mains
    frequency.
    """
    fit = select_mains_hum(likelihood, fit)
    several = len(fit.model.candidates) > 1
    for candidate in uncertain(fit.model) if several else ():
        reduced = select_mains_hum(likelihood, refit_without(likelihood, fit, candidate))
        if not evidence_gain(likelihood, reduced, fit):
            return drop_redundant(likelihood, reduced)
    return fit


def refit_without(likelihood: Likelihood, fit: Fit, candidate: Candidate) -> Fit:
    """The fit refitted with one of its terms taken out."""
    kept = [each for each in fit.model.candidates if each is not candidate]
    model = Model(fit.model.runs, fit.model.device, kept, fit.model.mains)
    return fit_model(likelihood, model, model.map_parameters_from(fit.model, fit.x))


def _selection_step(
    likelihood: Likelihood,
    nominal: Fit,
    best: Fit,
    candidate: Candidate,
    rivals: RivalFits,
) -> SelectionStep:
    """The selection step of one term of the final fit."""
    alone = len(best.model.candidates) == 1 and bool(candidate.term.free_parameters)
    return SelectionStep(candidate, nominal if alone else refit_without(likelihood, best, candidate), best, rivals)


def select_mains_hum(likelihood: Likelihood, fit: Fit) -> Fit:
    """The fit with hum of the one mains frequency that the recordings show, or of none."""
    return min(_fit_hum_variants(likelihood, fit), key=lambda each: each.neg2_log_evidence)


def _fit_hum_variants(likelihood: Likelihood, fit: Fit) -> list[Fit]:
    """The fit without hum, and with hum of each mains frequency alone."""
    mains_variants = ((), *((frequency,) for frequency in MAINS_HZ))
    models = [Model(fit.model.runs, fit.model.device, fit.model.candidates, mains) for mains in mains_variants]
    return fit_models(
        likelihood, [(model, model.map_parameters_from(fit.model, fit.x)) for model in models], max_iterations=3
    )


def _min_entropy_whiteners(fits: Iterable[Fit]) -> list[list[Whitener]]:
    """The whiteners with the lowest noise entropy among those of the fits.

    Hum of both mains frequencies together resembles a drift of the baseline and would raise the estimate of slow noise.
    """
    whiteners = [estimate_whiteners(fit.model, fit.x) for fit in fits]
    return min(whiteners, key=lambda noise: sum(float(np.log(whitener.psd).sum()) for row in noise for whitener in row))


def with_interference_line(likelihood: Likelihood, fit: Fit) -> Fit:
    """The same fit, with the strongest interfering line in the natural scales of its runs."""
    line = strongest_interfering_line(fit)
    if line is None:
        return fit
    runs = tuple(
        replace(run, scales={axis: replace(scales, line=line) for axis, scales in run.scales.items()})
        for run in fit.model.runs
    )
    model = Model(runs, fit.model.device, fit.model.candidates, fit.model.mains)
    return replace(fit, model=model)
