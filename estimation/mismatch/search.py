"""The search: nominal model, noise, candidates one after the other, then everything refitted together."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from estimation.mismatch.experiment import Run
from estimation.mismatch.fit import Comparison, Fit, solve, solve_all
from estimation.mismatch.free import FREE
from estimation.mismatch.instead import Lead, Leads, behind, instead, settled
from estimation.mismatch.lines import strongest_foreign_line
from estimation.mismatch.model import MAINS, Candidate, Model
from estimation.mismatch.naming import (
    LEAD_OVER_NEXT,
    LEAD_OVER_NOTHING,
    TRACKED,
    convincing,
    lead_of,
    near,
    possible,
    race,
)
from estimation.mismatch.noise import Whitener
from estimation.mismatch.screen import all_candidates
from estimation.mismatch.sparse import sparse
from estimation.mismatch.start import first_whiteners, grown, measured_whiteners, started, windows
from scanner.device import Device
from scanner.terms import Term

Array = NDArray[np.float64]
Progress = Callable[[str], None]

MOST_EFFECTS = 3
"""Effects looked for at a time."""

ADEQUATE = 1.08
"""Held-out reduced chi-square up to which named terms suffice: what a free correction finds beside them is how their
laws were written down (how a contact begins to slide), not another effect."""

LARGE = 10.0
"""Held-out reduced chi-square of the nominal device from which several named terms may stand against a free correction:
below it, three laws find something to explain in anything."""

NEXT_TO_NOTHING = 0.005
"""Share of the misfit that they may leave: 7 % of its amplitude."""

INADEQUATE = 1.3
"""Held-out reduced chi-square from which named terms are no explanation: near relatives stand in for something else."""

ASTRAY = 100.0
"""Reduced chi-square from which a fit has lost the motion: first order around it says nothing of a further effect."""

LIKELY = 3
"""Free corrections in the place of named terms, of which the numbers needed are told."""

CLOSE, NEARLY = 80.0, 0.1
"""Rivals within this of the best in -2 log evidence, or within this share of what the best gained, are refitted when
the noise has been measured anew."""


@dataclass(frozen=True)
class Round:
    """One effect found: the fits without and with it, and the rivals that were tried in its place.

    Attributes:
        candidate: what was added.
        before, after: fits without and with it, all else that was found in both, under the same noise.
        leads: its rivals when it was found.
    """

    candidate: Candidate
    before: Fit
    after: Fit
    leads: Leads


@dataclass(frozen=True)
class Search:
    """What was found.

    Attributes:
        comparison: under the last noise.
        nominal: the nominal device under the last noise.
        final: the device with all that was found.
        rounds: effect by effect.
    """

    comparison: Comparison
    nominal: Fit
    final: Fit
    rounds: tuple[Round, ...] = field(default_factory=tuple)


def search(runs: Sequence[Run], device: Device, terms: Mapping[str, Term], say: Progress = lambda text: None) -> Search:
    """Locate and name what ``device`` leaves out of ``runs``.

    Where a free correction does better than any one term but leaves something of a misfit that is large, several terms
    may be at work: they are kept if, one after the other, they leave next to nothing of it and less than it does.

    Args:
        terms: effects to look for.
        say: told what is being done.
    """
    model = Model(runs, device)
    say("nominal device")
    stops = windows(model)
    comparison = Comparison(runs, first_whiteners(model))
    early = grown(comparison, model, started(comparison, model, stops[0]).x, stops)
    comparison = Comparison(runs, _quietest(_by_hum(comparison, early[-1])))
    nominal = solve(comparison, model, early[-1].x)
    named = list(terms.values())
    states = [_State(comparison, nominal, with_hum(comparison, nominal), {})]
    states += _extended(states[0], [*named, *FREE.values()], early, stops, say)
    found = states[-1]
    if _is_free(found.best) and found.nominal.held_chi2 > LARGE and found.best.held_chi2 > ADEQUATE:
        several = _several(states[-2], _extended(states[-2], named, early, stops, say, found.tried))
        enough = several.best.held_chi2 - 1.0 < NEXT_TO_NOTHING * (several.nominal.held_chi2 - 1.0)
        if enough and solve(found.comparison, several.best.model, several.best.x).evidence < found.best.evidence:
            found = several
    if _is_free(found.best):
        # with the numbers alone that it needs its law is plainer, and better known
        fewer = sparse(found.comparison, found.best)
        if fewer is not None and fewer.evidence < found.best.evidence:
            found = replace(found, best=fewer)
    elif found.best.model.candidates:
        found = _unnamed(found)
    rounds = tuple(
        _round(found.comparison, found.nominal, found.best, each, found.rivals.get(each.key, ()))
        for each in found.best.model.candidates
    )
    return Search(found.comparison, found.nominal, found.best, rounds)


@dataclass(frozen=True)
class _State:
    """How far a search has come.

    Attributes:
        nominal, best: the nominal device and the best fit, under the same noise.
        rivals: by key.
        tried: fits of the named terms among which the newest was chosen, under the noise before it.
    """

    comparison: Comparison
    nominal: Fit
    best: Fit
    rivals: Mapping[str, Leads]
    tried: Sequence[Fit] = ()


def _extended(
    state: _State,
    terms: Sequence[Term],
    early: Sequence[Fit],
    stops: Sequence[float],
    say: Progress,
    tried: Sequence[Fit] = (),
) -> Iterator[_State]:
    """The states that a search passes as it takes up ``terms``, one after the other.

    Args:
        tried: fits of all that may come first, if these have been made.
    """
    comparison, nominal, best, rivals = state.comparison, state.nominal, state.best, dict(state.rivals)
    for _ in range(MOST_EFFECTS - len(best.model.candidates)):
        taken = {each.key for each in best.model.candidates}
        if taken:
            # The noise was measured where these had not been fitted under it: what they left then passes for it.
            comparison = Comparison(best.model.runs, measured_whiteners(best.model, best.x))
            best = solve(comparison, best.model, best.x)
        best = with_line(comparison, best)
        adequate = bool(rivals) and best.held_chi2 < ADEQUATE
        pool = [each for each in terms if not (adequate and each.effect in FREE)]
        candidates = [each for each in all_candidates(best.model.device, best.model, pool) if each.key not in taken]
        say(f"{len(candidates)} candidates" + (f" beside {', '.join(sorted(taken))}" if taken else ""))
        if tried:
            fits, tried = list(tried), ()
        elif best.chi2 < (ASTRAY if taken else TRACKED) * best.rows.sum():
            fits = near(comparison, best, candidates)
        else:
            if taken:
                say(f"where {', '.join(sorted(taken))} still follows")
                early = grown(comparison, best.model, best.model.embed(early[0].model, early[0].x), stops)
            fits = race(comparison, best.model, early, stops, candidates)
        if not fits or best.evidence - fits[0].evidence < LEAD_OVER_NOTHING:
            return
        say(f"refit with {fits[0].model.candidates[-1].key}")
        comparison = Comparison(best.model.runs, measured_whiteners(fits[0].model, fits[0].x))
        by_name = [fit for fit in fits if not _is_free(fit)]
        reach = max(CLOSE, NEARLY * (best.evidence - fits[0].evidence))
        close = [fit for fit in fits if fit.evidence < fits[0].evidence + reach][:6]
        close = solve_all(comparison, [(fit.model, fit.x) for fit in close])
        close = sorted((fit for fit in close if possible(fit)), key=lambda fit: fit.evidence)
        before = solve(comparison, best.model, best.x, turns=4)
        nominal = before if not rivals else solve(comparison, nominal.model, nominal.x, turns=4)
        found = next((fit for fit in close if convincing(comparison, before, fit)), None)
        if found is None and before.held_chi2 > INADEQUATE and not taken:
            found = next((fit for fit in close if _is_free(fit)), None)  # something is missing, if only its stage shows
        if found is None:
            yield _State(comparison, nominal, before, rivals, by_name)
            return
        named = [each for each in candidates if each.term.effect not in FREE]
        leads = _behind_newest(found, before, close)
        if _is_free(found):
            say("named terms in the free correction's place")
            comparison, before, found = _by_name(comparison, before, found, named)
            close = []  # of another noise, if names were found
        if not _is_free(found) and found.chi2 < ASTRAY * found.rows.sum():
            # The first to be taken may have imitated all: where much is left, its place is open too.
            kept = len(best.model.candidates) if found.held_chi2 <= TRACKED else 0
            final = settled(comparison, found, named, len(found.model.candidates) - kept)
            earlier = _behind_newest(final.fit, before, close)
            leads = {key: _merged(own, earlier.get(key, ())) for key, own in final.leads.items()}
            found = final.fit
        rivals |= leads
        best = needed_only(comparison, found)
        yield _State(comparison, nominal, best, rivals, by_name)
        if _is_free(best):
            return


def _several(start: _State, further: Iterator[_State]) -> _State:
    """The last of ``further`` as long as each takes away at least half of the misfit that the one before it left."""
    last = start
    for state in further:
        worth = state.best.held_chi2 - 1.0 < 0.5 * (last.best.held_chi2 - 1.0)
        last = state
        if not worth:
            break
    return last


def _by_name(comparison: Comparison, before: Fit, free: Fit, named: Sequence[Candidate]) -> tuple[Comparison, Fit, Fit]:
    """Named terms instead of a free correction where they explain more for less, under the noise that they leave.

    Returns:
        comparison, the fit before, the fit with the terms or, where none will do, with the free correction.
    """
    others = instead(comparison, free, free.model.candidates[-1:], named, pairs=True)
    others = [fit for fit in others if fit.evidence < free.evidence and convincing(comparison, before, fit)]
    if not others:
        return comparison, before, free
    found = others[0]
    fewer = [fit for fit in others if len(fit.model.candidates) < len(found.model.candidates)]
    # the second of two is held to what any second effect is held to
    if fewer and not convincing(comparison, fewer[0], found):
        found = fewer[0]
    comparison = Comparison(comparison.runs, measured_whiteners(found.model, found.x))
    return comparison, solve(comparison, before.model, before.x), solve(comparison, found.model, found.x)


def _unnamed(state: _State) -> _State:
    """A free correction in the place of named terms, if it explains more with the numbers it needs; they are rivals.

    In the place of all that stand in one stage: they may be the first terms of the series of one law that has no name.
    While the motion was not followed, that law could not be fitted; around them it can. Or, where too much is left, in
    the place of the weightiest.
    """
    comparison, fit = state.comparison, state.best
    terms = fit.model.candidates
    gone = max(([each for each in terms if each.term.stage == one.term.stage] for one in terms), key=len)
    if len(gone) == 1:
        if fit.held_chi2 < INADEQUATE:
            return state
        gone = [max(terms, key=lambda each: without(comparison, fit, each).evidence)]
    free = all_candidates(fit.model.device, fit.model, FREE.values())
    others = [each for each in instead(comparison, fit, gone, free) if each.chi2 < fit.chi2]
    fewer = [each for each in (sparse(comparison, other) for other in others[:LIKELY]) if each is not None]
    best = min(fewer, key=lambda each: each.evidence, default=fit)
    if best.evidence > fit.evidence - LEAD_OVER_NEXT:
        return state
    found = needed_only(comparison, best)
    worse = fit.chi2 + fit.penalty - best.chi2 - best.penalty
    leads = tuple(Lead(fit.evidence - best.evidence, each, worse) for each in gone)
    return replace(state, best=found, rivals={**state.rivals, found.model.candidates[-1].key: leads})


def _behind_newest(found: Fit, before: Fit, tried: Sequence[Fit]) -> dict[str, Leads]:
    """Of those tried, the rivals of the one term that ``found`` has and ``before`` has not."""
    old = {each.key for each in before.model.candidates}
    new = [each.key for each in found.model.candidates if each.key not in old]
    less_likely = [fit for fit in tried if fit.evidence > found.evidence and fit.model.candidates[-1].key not in new]
    return {new[0]: behind(found, less_likely)} if len(new) == 1 else {}


def _merged(*parts: Leads) -> Leads:
    """All rivals, the nearest first: each as near, and fitting as well, as the best of its fits in either."""
    nearest: dict[str, Lead] = {}
    for lead in (each for part in parts for each in part):
        known = nearest.setdefault(lead.candidate.key, lead)
        nearest[lead.candidate.key] = Lead(min(known.behind, lead.behind), lead.candidate, min(known.worse, lead.worse))
    return tuple(sorted(nearest.values(), key=lambda each: each.behind))


def _is_free(fit: Fit) -> bool:
    return bool(fit.model.candidates) and fit.model.candidates[-1].term.effect in FREE


def needed_only(comparison: Comparison, fit: Fit) -> Fit:
    """The fit without those of several terms that the others make superfluous.

    A near relative may stand in for the true effect until that one is there to be chosen beside it. Hum is judged anew
    with every term and without: in a short recording a drift and the wrong mains look like the right one.
    """
    fit = with_hum(comparison, fit)
    several = len(fit.model.candidates) > 1
    for each in fit.model.candidates if several else ():
        less = with_hum(comparison, without(comparison, fit, each))
        if not lead_of(comparison, less, fit):
            return needed_only(comparison, less)
    return fit


def without(comparison: Comparison, fit: Fit, candidate: Candidate) -> Fit:
    """The fit refitted with one of its terms taken out."""
    kept = [each for each in fit.model.candidates if each is not candidate]
    model = Model(fit.model.runs, fit.model.device, kept, fit.model.mains)
    return solve(comparison, model, model.embed(fit.model, fit.x))


def _round(
    comparison: Comparison,
    nominal: Fit,
    best: Fit,
    candidate: Candidate,
    leads: Leads,
) -> Round:
    """What one term of the final fit does there."""
    alone = len(best.model.candidates) == 1
    return Round(candidate, nominal if alone else without(comparison, best, candidate), best, leads)


def with_hum(comparison: Comparison, fit: Fit) -> Fit:
    """The fit with hum of the one mains frequency that the recordings show, or of none."""
    return min(_by_hum(comparison, fit), key=lambda each: each.evidence)


def _by_hum(comparison: Comparison, fit: Fit) -> list[Fit]:
    """The fit without hum, and with hum of each mains frequency alone."""
    heard = ((), *((each,) for each in MAINS))
    models = [Model(fit.model.runs, fit.model.device, fit.model.candidates, mains) for mains in heard]
    return solve_all(comparison, [(model, model.embed(fit.model, fit.x)) for model in models], turns=3)


def _quietest(fits: Iterable[Fit]) -> list[list[Whitener]]:
    """The least noise that one of the fits leaves.

    Hum of both mains at once takes after a baseline that drifts, and leaves lines that would excuse it as slow noise.
    """
    found = [measured_whiteners(fit.model, fit.x) for fit in fits]
    return min(found, key=lambda noise: sum(float(np.log(each.psd).sum()) for row in noise for each in row))


def with_line(comparison: Comparison, fit: Fit) -> Fit:
    """The same fit, its scales told of the strongest line that neither drive nor motion explains."""
    line = strongest_foreign_line(fit)
    if line is None:
        return fit
    runs = tuple(
        replace(run, scales={axis: replace(scales, line=line) for axis, scales in run.scales.items()})
        for run in fit.model.runs
    )
    model = Model(runs, fit.model.device, fit.model.candidates, fit.model.mains)
    return replace(fit, model=model)
