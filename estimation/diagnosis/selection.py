"""Selection of the laws that a device omits, around fits that have the phase of the motion right."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from estimation.candidate_terms.anchor import fit_anchor, fit_growing, follow_motion, max_residual_ratio, residual_ratio
from estimation.candidate_terms.curves import CURVE_TERMS
from estimation.candidate_terms.discrepancy import DISCREPANCY_TERMS, is_discrepancy
from estimation.candidate_terms.linear_model import RivalFit
from estimation.candidate_terms.screening import all_candidates, damped_start
from estimation.candidate_terms.significance import (
    evidence_gain,
    has_possible_signs,
    residual_is_noise,
    satisfies_sign_constraints,
)
from estimation.device_fit.data import Run
from estimation.device_fit.fit import (
    Fit,
    Likelihood,
    fit_model,
    fit_models,
    misfit,
    nominal_values_are_improbable,
)
from estimation.device_fit.hum import fit_hum_variants, min_entropy_whiteners, select_mains_hum
from estimation.device_fit.initial import (
    fit_progressively,
    flat_whiteners,
    refit_under_own_noise,
    window_schedule,
)
from estimation.device_fit.interference import with_interference_line
from estimation.device_fit.model import Model
from estimation.device_fit.parameters import Candidate
from estimation.diagnosis.clipping import clipped_readouts
from estimation.diagnosis.discrepancy_selection import choose_discrepancy
from estimation.diagnosis.from_stated_values import (
    fit_from_stated_values,
    fit_in_another_minimum,
    fit_nonlinear_law,
    fit_with_stated_values,
    nonlinear_starts,
)
from estimation.diagnosis.law_selection import SelectedTerms, choose_laws
from estimation.diagnosis.necessity import least_explained, need_beside
from estimation.diagnosis.pruning import (
    drop_redundant,
    fit_to_convergence,
    refit_without,
    select_hum,
)
from estimation.diagnosis.search import Progress, Search
from estimation.parallel import map_fits
from scanner.device import Device
from scanner.terms import Term
from scanner.wording import counted

AMPLITUDE_EFFECTS = (("cubic-stiffness", "quadratic-drag"), ("gravity-stiffness", "quadratic-drag"))
"""Terms that are fitted first, on all axes, where the nominal device does not follow the motion: a frequency and a
damping that depend on the amplitude. A polynomial is no spring at the swings of a pendulum above a right angle."""

ANCHOR_EFFECTS = (("free-stiffness",), ("free-mechanics",))
"""Terms that are fitted in this order where these do not follow it: a stiffness and a damping that drift, a free
torque."""

ABSORBED_EFFECTS = (("resonance-drift",), ("resonance-drift", "damping-drift"))
"""Effects that nominal values absorb most easily, together on all axes: amplitude and phase of the motion follow the
resonance through every value of mechanics and capacitance. A drifting damping beside it follows slow changes of both
whatever their cause, as a clock or a lag beside drifting resonances."""

MAX_ABSORBED_PROBABILITY = 0.05
"""Probability of the fitted nominal values below which drifts around the stated values are tried. It costs one in
twenty recordings without any effect additional fits; what is found is judged by its evidence."""

MAX_NONLINEAR_STARTS = 8
"""Starts of a law that is linear in no amplitude that are fitted, those with the largest predicted gain. In five
recordings of a mode that grows, of 3 to 82 starts, the best fit came from one of the first six."""


@dataclass(frozen=True)
class SelectionStep:
    """One selected term, the fits without and with it, and its rivals.

    Attributes:
        candidate: the term.
        before, after: fits without and with the term. Both contain all other selected terms and use the same noise.
        rivals: terms that were compared with it.
    """

    candidate: Candidate
    before: Fit
    after: Fit
    rivals: tuple[RivalFit, ...]


@dataclass(frozen=True)
class SelectionResult:
    """Result of the selection.

    Attributes:
        likelihood: of the recordings, with the noise spectrum of the last estimate.
        nominal: fit of the nominal device under that likelihood.
        final: fit of the device with all selected terms.
        steps: one for each selected term.
        remaining: fall of -2 log evidence by free corrections of all stages beside named laws; 0 without them.
    """

    likelihood: Likelihood
    nominal: Fit
    final: Fit
    steps: tuple[SelectionStep, ...] = ()
    remaining: float = 0.0

    @cached_property
    def without_rails(self) -> Fit:
        """Fit of the nominal device without the rails at which samples stand: their shares are of its misfit."""
        nominal = self.nominal
        if not nominal.model.candidates:
            return nominal
        model = nominal.model.with_candidates(())
        return fit_model(self.likelihood, model, model.map_parameters_from(nominal.model, nominal.x))


def select_terms(
    runs: Sequence[Run], device: Device, terms: Mapping[str, Term], progress: Progress = lambda text: None
) -> SelectionResult:
    """Select the terms that ``device`` omits from ``runs``.

    Named laws are chosen around the nominal fit. If none suffice, they are chosen around the fit of a discrepancy term;
    if none suffice there either, that term is selected.

    Args:
        terms: candidates by effect.
        progress: called with one line of text at every step.
    """
    clipped = clipped_readouts(runs, terms.get("saturation"))
    model = Model(runs, device, clipped)
    progress("nominal device")
    stops = window_schedule(model)
    likelihood = Likelihood(runs, flat_whiteners(model))
    early = fit_progressively(likelihood, model, stops)
    whole = follow_motion(likelihood, early, stops)
    likelihood = Likelihood(runs, min_entropy_whiteners(fit_hum_variants(likelihood, whole)))
    nominal = select_mains_hum(likelihood, fit_model(likelihood, model, whole.x))
    nominal = with_interference_line(likelihood, nominal)
    certain = {candidate.term.effect for candidate in clipped}
    named = [term for term in terms.values() if term.effect not in certain]
    pool = all_candidates(nominal.model, [*named, *DISCREPANCY_TERMS.values()])
    progress(counted(len(pool), "candidate"))
    curves = all_candidates(nominal.model, CURVE_TERMS.values())
    selected = _choose_terms(Search(likelihood, nominal, early, stops, pool, curves, progress))
    steps = tuple(_step(selected, candidate) for candidate in selected.fit.model.candidates)
    return SelectionResult(selected.likelihood, selected.nominal, selected.fit, steps, selected.need.remaining)


def _choose_terms(search: Search) -> SelectedTerms:
    """Named laws, else a discrepancy term, else nothing; beside each a law that is linear in no amplitude."""
    likelihood, nominal = search.likelihood, search.nominal
    anchor, tried = _fit_amplitude_effects(search)
    if not _is_explained(anchor, nominal):
        drifting = _fit_drifts_from_stated_values(search)
        other = fit_in_another_minimum(likelihood, nominal, drifting)
        if other is not None:
            return SelectedTerms(likelihood, other, other)
        if anchor is nominal or nominal_values_are_improbable(anchor) or _has_less_evidence(anchor, drifting):
            from_stated_values = _choose_from_stated_values(search, drifting)
            if from_stated_values is not None:
                return _with_nonlinear_term(search, from_stated_values)
        if anchor is nominal:
            groups = [group for effects in ANCHOR_EFFECTS if (group := search.of_effects(effects))]
            anchor, others = fit_anchor(likelihood, nominal, search.early, search.stops, groups)
            tried += others
    laws = _choose_laws(search, anchor)
    if laws is not None:
        laws = _with_nonlinear_term(search, laws)
        if laws.need.certain and (laws.need.takes_bulk or not nominal_values_are_improbable(laws.fit)):
            return laws
    search.progress("discrepancy terms")
    selected = choose_discrepancy(search, anchor, [fit for fit in tried if is_discrepancy(fit.model.candidates[-1])])
    if laws is not None and laws.need.certain and (selected is None or _are_needed(search, laws, selected)):
        return laws
    if selected is not None:
        around = _choose_laws(search, selected.fit)
        selected = around if around and around.need.certain else selected
    return _with_nonlinear_term(search, selected or SelectedTerms(likelihood, nominal, nominal))


def _fit_amplitude_effects(search: Search) -> tuple[Fit, list[Fit]]:
    """The fit with the best evidence of those with ``AMPLITUDE_EFFECTS`` that follow the motion, and all fits made.

    It is the nominal fit if that follows the motion or none of them does. They take a thirtieth of the time of fits
    from the stated values; the second one is not made where the first leaves only noise. A spring that hardens is no
    pendulum.
    """
    anchor, tried = search.nominal, list[Fit]()
    for effects in AMPLITUDE_EFFECTS:
        group = search.of_effects(effects)
        if {candidate.term.effect for candidate in group} != set(effects):
            continue
        fit, made = fit_anchor(search.likelihood, search.nominal, search.early, search.stops, [group])
        tried += made
        possible = fit is not search.nominal and has_possible_signs(fit, effects[0])
        if possible and (anchor is search.nominal or _has_less_evidence(anchor, [fit])):
            anchor = fit
        if not made or _is_explained(anchor, search.nominal):
            break
    return anchor, tried


def _is_explained(anchor: Fit, nominal: Fit) -> bool:
    """Whether a fit with other terms than the nominal one leaves only noise, with probable nominal values."""
    return anchor is not nominal and residual_is_noise(anchor) and not nominal_values_are_improbable(anchor)


def _has_less_evidence(fit: Fit, others: Sequence[Fit]) -> bool:
    """Whether one of other fits has better evidence."""
    return any(other.neg2_log_evidence < fit.neg2_log_evidence for other in others)


def _are_needed(search: Search, laws: SelectedTerms, discrepancy: SelectedTerms) -> bool:
    """Whether laws are needed beside free corrections, where one of these follows the motion without them.

    Nominal values that have absorbed a misfit are far from those with which a correction alone explains it, which the
    linear model around the laws does not show.
    """
    likelihood = discrepancy.likelihood
    fit = fit_model(likelihood, laws.fit.model, laws.fit.x)
    explained = misfit(discrepancy.nominal) - misfit(fit)
    return need_beside(likelihood, discrepancy.fit, fit, search.discrepancies, explained).certain


def _fit_drifts_from_stated_values(search: Search) -> list[Fit]:
    """Fits from the stated values with the drifts of ``ABSORBED_EFFECTS``; none where nominal values are probable."""
    groups = [search.of_effects(effects) for effects in ABSORBED_EFFECTS]
    if not groups[0] or not nominal_values_are_improbable(search.nominal, MAX_ABSORBED_PROBABILITY):
        return []
    search.progress("stated values, with drifting resonances")

    def fit(drifts: Sequence[Candidate]) -> Fit:
        return fit_from_stated_values(search.likelihood, search.nominal, drifts, search.stops[0])

    return map_fits(fit, groups, search.likelihood.steps)


def _choose_from_stated_values(search: Search, drifting: Sequence[Fit]) -> SelectedTerms | None:
    """Named laws around a fit from the stated values, where nominal values have absorbed a misfit.

    It is that with the drifts that have the best evidence or, where all drifts leave more than noise, with a law that
    is linear in no amplitude and leaves only noise. None where nominal values have absorbed nothing, where drifts
    follow the motion neither with probable nor with improbable nominal values, or where the named laws are not the
    answer or leave improbable values too.

    Args:
        drifting: fits with drifts from the stated values.
    """
    if not drifting:
        return None
    likelihood, nominal, first = search.likelihood, search.nominal, search.stops[0]
    if not any(map(residual_is_noise, drifting)):
        search.progress("stated values, with laws that are linear in no amplitude")
        nonlinear = fit_nonlinear_law(likelihood, nominal, search.pool, search.stops)
        if nonlinear is not None:
            selected = _choose_beside_nonlinear_term(search, likelihood, nominal, nonlinear)
            if selected is not None and _is_answer(selected):
                return selected
    base = min(drifting, key=lambda fit: fit.neg2_log_evidence)
    absorbed = nominal_values_are_improbable(nominal) or evidence_gain(likelihood, nominal, base)
    follows = residual_ratio(likelihood, base) < max_residual_ratio(likelihood, search.early[0], first)
    if not absorbed or (nominal_values_are_improbable(base) and not follows):
        return None
    selected = _choose_laws(search, base)
    if selected is not None and nominal_values_are_improbable(selected.fit):
        # They have absorbed a further effect, which is visible beside these laws at the stated values only.
        kept = fit_with_stated_values(likelihood, selected.fit.model, selected.fit.x, first)
        selected = _choose_laws(search, kept)
    return selected if selected is not None and _is_answer(selected) else None


def _is_answer(selected: SelectedTerms) -> bool:
    """Whether selected laws are the answer and have left the nominal values probable."""
    return selected.need.certain and not nominal_values_are_improbable(selected.fit)


def _choose_laws(search: Search, anchor: Fit) -> SelectedTerms | None:
    """The named laws that take the bulk of the misfit of the nominal device; None where none are significant."""
    selected = choose_laws(anchor, search.nominal, search.pool, search.progress)
    if selected is None:
        return None
    fit, without = drop_redundant(selected.likelihood, selected.fit)
    if not evidence_gain(selected.likelihood, select_hum(selected.likelihood, selected.nominal), fit):
        return None
    return replace(selected, fit=fit, without=without)


def _with_nonlinear_term(search: Search, selected: SelectedTerms) -> SelectedTerms:
    """The selection with a law that is linear in no amplitude, as a clip level or a mode that grows, where one gains.

    The named laws are chosen again beside it. Where free corrections beside the selected laws have no evidence, such a
    law has none either; where they take the bulk of the misfit, it is sought beside them and not in their place.
    """
    likelihood = selected.likelihood
    if selected.need.remaining < 0.0:
        return selected
    bases = [selected.nominal]
    if selected.need.possible:
        bases = [selected.fit] if selected.need.takes_bulk else [selected.nominal, selected.fit]
    scored = [
        (base, score)
        for base in bases
        for score in nonlinear_starts(likelihood, base, search.pool)[:MAX_NONLINEAR_STARTS]
    ]
    starts = [(s.model, damped_start(likelihood, base, s.model, s.x, s.step)) for base, s in scored]
    most = misfit(selected.fit) - least_explained(selected.need)
    fits = zip((base for base, _ in scored), fit_models(likelihood, starts, abort_above=most), strict=True)
    possible = [(base, fit) for base, fit in fits if satisfies_sign_constraints(fit)]
    if not possible:
        return selected
    base, best = min(possible, key=lambda pair: pair[1].neg2_log_evidence)
    if not evidence_gain(likelihood, selected.fit, best):
        return selected
    converged = fit_to_convergence(likelihood, best.model, best.x)
    # A mode that grows is determined early, while the misfit of the whole recording has several minima.
    growing = fit_growing(likelihood, best.model, converged.x, search.stops[0])
    best = min(converged, growing, key=misfit)
    if misfit(best) > most:
        return selected
    return _choose_beside_nonlinear_term(search, likelihood, base, best) or selected


def _choose_beside_nonlinear_term(
    search: Search, likelihood: Likelihood, base: Fit, with_law: Fit
) -> SelectedTerms | None:
    """A law that is linear in no amplitude and named laws beside it; None where corrections do not need it.

    Args:
        base, with_law: fits without and with it, under ``likelihood``.
    """
    need = need_beside(likelihood, base, with_law, search.discrepancies, misfit(base) - misfit(with_law))
    if not need.possible:
        return None
    search.progress(f"laws beside {with_law.model.candidates[-1].key}")
    with_laws = _choose_laws(search, with_law)
    if with_laws is not None:
        return with_laws
    likelihood, with_law = refit_under_own_noise(with_law)
    before = fit_model(likelihood, search.nominal.model, search.nominal.x)
    fit, removed = drop_redundant(likelihood, with_law)
    return SelectedTerms(likelihood, before, fit, need=need, without=removed)


def _step(selected: SelectedTerms, candidate: Candidate) -> SelectionStep:
    """The selection step of one term."""
    fit, before = selected.fit, selected.without.get(candidate.key)
    if before is None:
        alone = len(fit.model.candidates) == 1 and bool(candidate.term.free_parameters)
        before = selected.nominal if alone else refit_without(selected.likelihood, fit, candidate)
    return SelectionStep(candidate, before, fit, selected.rivals.get(candidate.key, ()))
