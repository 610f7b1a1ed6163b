"""Stepwise selection of terms by evidence: nominal model, noise, one term after the other, joint refit."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

from estimation.diagnosis.clipping import clipped_readouts
from estimation.diagnosis.data import Run
from estimation.diagnosis.discrepancy import DISCREPANCY_TERMS
from estimation.diagnosis.discrepancy_exchange import (
    MAX_DISCREPANCY_FITS,
    ends_with_discrepancy,
    replace_discrepancy_by_terms,
)
from estimation.diagnosis.exchange import RivalFit, RivalFits, exchange_to_convergence, fit_exchanges, rivals_of
from estimation.diagnosis.fit import Fit, Likelihood, fit_model, fit_models
from estimation.diagnosis.hum import fit_hum_variants, min_entropy_whiteners, select_mains_hum
from estimation.diagnosis.initial import (
    estimate_whiteners,
    fit_initial_state,
    fit_progressively,
    flat_whiteners,
    window_schedule,
)
from estimation.diagnosis.interference import with_interference_line
from estimation.diagnosis.law_selection import choose_laws
from estimation.diagnosis.model import Model, uncertain
from estimation.diagnosis.parameters import Candidate
from estimation.diagnosis.progressive_fit import fit_candidates_progressively, fit_screened_candidates
from estimation.diagnosis.pruning import drop_redundant, prune_by_evidence, refit_without
from estimation.diagnosis.screening import all_candidates
from estimation.diagnosis.significance import (
    DETECTION_THRESHOLD,
    UNIQUE_NAME_THRESHOLD,
    is_significant,
    satisfies_sign_constraints,
)
from estimation.diagnosis.windows import CHI2_ADEQUATE, CHI2_LINEARISABLE
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
    likelihood = Likelihood(runs, min_entropy_whiteners(fit_hum_variants(likelihood, early[-1])))
    nominal = select_mains_hum(likelihood, fit_model(likelihood, model, early[-1].x))
    named = [term for term in terms.values() if term.effect not in {certain.term.effect for certain in clipped}]
    states = [SelectionState(likelihood, nominal, nominal, {})]
    states += _forward_steps(states[0], [*named, *DISCREPANCY_TERMS.values()], early, stops, progress)
    selected = states[-1]
    if not selected.settled and len(uncertain(selected.best.model)) > 1:
        pool = all_candidates(device, selected.best.model, [*named, *DISCREPANCY_TERMS.values()])
        chosen = _LawChoice(selected.nominal, pool, selected.rivals, progress)
        if chosen.settles(selected.best) and chosen.state is not None:
            selected = chosen.state
    if (
        ends_with_discrepancy(selected.best)
        and selected.nominal.validation_chi2 > CHI2_LARGE
        and selected.best.validation_chi2 > CHI2_ADEQUATE
    ):
        several = _accept_while_halving(
            states[-2], _forward_steps(states[-2], named, early, stops, progress, selected.tried)
        )
        enough = several.best.validation_chi2 - 1.0 < MAX_REMAINING_MISFIT_RATIO * (
            several.nominal.validation_chi2 - 1.0
        )
        if (
            enough
            and fit_model(selected.likelihood, several.best.model, several.best.x).neg2_log_evidence
            < selected.best.neg2_log_evidence
        ):
            selected = several
    if ends_with_discrepancy(selected.best):
        # with the required amplitudes only, its law is simpler and better determined
        fewer = prune_by_evidence(selected.likelihood, selected.best)
        if fewer is not None and fewer.neg2_log_evidence < selected.best.neg2_log_evidence:
            selected = replace(selected, best=fewer)
    elif len(selected.best.model.candidates) > len(clipped) and not selected.settled:
        selected = _replace_terms_by_discrepancy(selected)
    steps = tuple(_selection_step(selected, candidate) for candidate in selected.best.model.candidates)
    return SelectionResult(selected.likelihood, selected.nominal, selected.best, steps)


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
        taken = {candidate.key for candidate in best.model.candidates}
        if taken:
            # The noise was estimated before these terms were fitted, so it may contain part of their effect.
            likelihood = Likelihood(best.model.runs, estimate_whiteners(best.model, best.x))
            best = fit_model(likelihood, best.model, best.x)
        best = with_interference_line(likelihood, best)
        adequate = bool(rivals) and best.validation_chi2 < CHI2_ADEQUATE
        pool = [term for term in terms if not (adequate and term.effect in DISCREPANCY_TERMS)]
        possible = all_candidates(best.model.device, best.model, pool)
        candidates = [candidate for candidate in possible if candidate.key not in taken]
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
        by_name = [fit for fit in fits if not ends_with_discrepancy(fit)]
        reach = max(REFIT_MARGIN, REFIT_MARGIN_RELATIVE * (best.neg2_log_evidence - fits[0].neg2_log_evidence))
        close = [fit for fit in fits if fit.neg2_log_evidence < fits[0].neg2_log_evidence + reach][:6]
        close = fit_models(likelihood, [(fit.model, fit.x) for fit in close])
        close = sorted((fit for fit in close if satisfies_sign_constraints(fit)), key=lambda fit: fit.neg2_log_evidence)
        before = fit_model(likelihood, best.model, best.x, max_iterations=4)
        nominal = before if not rivals else fit_model(likelihood, nominal.model, nominal.x, max_iterations=4)
        extended = next((fit for fit in close if is_significant(likelihood, before, fit)), None)
        if extended is None and before.validation_chi2 > CHI2_INADEQUATE and not taken:
            extended = next(
                (fit for fit in close if ends_with_discrepancy(fit)), None
            )  # an effect is missing, of which only the stage is known
        if extended is None:
            yield SelectionState(likelihood, nominal, before, rivals, by_name)
            return
        named = [candidate for candidate in candidates if candidate.term.effect not in DISCREPANCY_TERMS]
        leads = _rivals_of_newest(extended, before, close)
        if ends_with_discrepancy(extended):
            progress("named laws beside the discrepancy")
            if chosen.settles(extended) and chosen.state is not None:
                yield chosen.state
                return
            likelihood, before, extended = replace_discrepancy_by_terms(likelihood, before, extended, named)
            close = []  # they were fitted under another noise if terms were exchanged
        if not ends_with_discrepancy(extended) and extended.chi2 < CHI2_DIVERGED * extended.rows.sum():
            # The first term may imitate several effects: where much misfit remains, it may be exchanged too.
            kept = len(best.model.candidates) if extended.validation_chi2 <= CHI2_LINEARISABLE else 0
            newest = min(len(extended.model.candidates) - kept, len(uncertain(extended.model)))
            final = exchange_to_convergence(likelihood, extended, named, newest)
            earlier = _rivals_of_newest(final.fit, before, close)
            leads = {key: _merge_rivals(own, earlier.get(key, ())) for key, own in final.rivals.items()}
            extended = final.fit
        rivals |= leads
        best = drop_redundant(likelihood, extended)
        yield SelectionState(likelihood, nominal, best, rivals, by_name)
        if ends_with_discrepancy(best):
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


def _replace_terms_by_discrepancy(state: SelectionState) -> SelectionState:
    """Replace named terms by one pruned discrepancy term if that lowers -2 log evidence by ``UNIQUE_NAME_THRESHOLD``.

    All terms of one stage are replaced: they may be the first terms of the series of one law without a name, which can
    be fitted only around a model that has the phase right. With a single term per stage, the most important term is
    replaced if the fit is inadequate. The replaced terms are reported as rivals. Otherwise the state is unchanged.
    """
    likelihood, fit = state.likelihood, state.best
    terms = uncertain(fit.model)
    by_stage = [[other for other in terms if other.term.stage == first.term.stage] for first in terms]
    removed = max(by_stage, key=len)
    if len(removed) == 1:
        if fit.validation_chi2 < CHI2_INADEQUATE:
            return state
        removed = [max(terms, key=lambda term: refit_without(likelihood, fit, term).neg2_log_evidence)]
    free = all_candidates(fit.model.device, fit.model, DISCREPANCY_TERMS.values())
    others = [other for other in fit_exchanges(likelihood, fit, removed, free) if other.chi2 < fit.chi2]
    fewer = [
        pruned
        for pruned in (prune_by_evidence(likelihood, other) for other in others[:MAX_DISCREPANCY_FITS])
        if pruned is not None
    ]
    best = min(fewer, key=lambda other: other.neg2_log_evidence, default=fit)
    if best.neg2_log_evidence > fit.neg2_log_evidence - UNIQUE_NAME_THRESHOLD:
        return state
    free_fit = drop_redundant(likelihood, best)
    worse = fit.chi2 + fit.penalty - best.chi2 - best.penalty
    leads = tuple(RivalFit(fit.neg2_log_evidence - best.neg2_log_evidence, candidate, worse) for candidate in removed)
    return replace(state, best=free_fit, rivals={**state.rivals, free_fit.model.candidates[-1].key: leads})


def _rivals_of_newest(extended: Fit, before: Fit, tried: Sequence[Fit]) -> dict[str, RivalFits]:
    """Rivals, among ``tried``, of the one term that ``extended`` has in addition to ``before``."""
    old = {candidate.key for candidate in before.model.candidates}
    new = [candidate.key for candidate in extended.model.candidates if candidate.key not in old]
    less_likely = [
        fit
        for fit in tried
        if fit.neg2_log_evidence > extended.neg2_log_evidence and fit.model.candidates[-1].key not in new
    ]
    return {new[0]: rivals_of(extended, less_likely)} if len(new) == 1 else {}


def _merge_rivals(*parts: RivalFits) -> RivalFits:
    """All rivals with their smallest gaps, sorted by evidence."""
    nearest: dict[str, RivalFit] = {}
    for rival in (entry for part in parts for entry in part):
        previous = nearest.setdefault(rival.candidate.key, rival)
        nearest[rival.candidate.key] = RivalFit(
            min(previous.evidence_gap, rival.evidence_gap), rival.candidate, min(previous.misfit_gap, rival.misfit_gap)
        )
    return tuple(sorted(nearest.values(), key=lambda entry: entry.evidence_gap))


def _selection_step(state: SelectionState, candidate: Candidate) -> SelectionStep:
    """The selection step of one term of the best fit."""
    best, rivals = state.best, state.rivals.get(candidate.key, ())
    alone = len(best.model.candidates) == 1 and bool(candidate.term.free_parameters)
    before = state.nominal if alone else refit_without(state.likelihood, best, candidate)
    return SelectionStep(candidate, before, best, rivals)
