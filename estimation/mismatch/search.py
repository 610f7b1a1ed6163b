"""The search: nominal model, noise, candidates one after the other, then everything refitted together."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from estimation.mismatch.experiment import Run
from estimation.mismatch.fit import Comparison, Fit, solve
from estimation.mismatch.free import FREE
from estimation.mismatch.lines import strongest_foreign_line
from estimation.mismatch.model import Candidate, Model
from estimation.mismatch.naming import LEAD_OVER_NOTHING, TRACKED, convincing, near, possible, race
from estimation.mismatch.screen import all_candidates
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

CLOSE = 80.0
"""Rivals within this of the best in -2 log evidence are refitted when the noise has been measured anew."""


@dataclass(frozen=True)
class Round:
    """One effect found: the fits without and with it, and the rivals that were tried in its place.

    Attributes:
        candidate: what was added.
        before, after: fits without and with it, all else that was found in both, under the same noise.
        leads: its rivals when it was found, each with its distance behind in -2 log evidence.
    """

    candidate: Candidate
    before: Fit
    after: Fit
    leads: tuple[tuple[float, Candidate], ...]


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

    Args:
        terms: effects to look for.
        say: told what is being done.
    """
    model = Model(runs, device)
    say("nominal device")
    stops = windows(model)
    comparison = Comparison(runs, first_whiteners(model))
    early = grown(comparison, model, started(comparison, model, stops[0]).x, stops)
    comparison = Comparison(runs, measured_whiteners(model, early[-1].x))
    best = with_hum(comparison, solve(comparison, model, early[-1].x))
    nominal = best
    rivals: dict[str, tuple[tuple[float, Candidate], ...]] = {}
    for number in range(MOST_EFFECTS):
        best = with_line(comparison, best)
        candidates = all_candidates(device, best.model, [*terms.values(), *FREE.values()])
        taken = {each.key for each in best.model.candidates}
        candidates = [each for each in candidates if each.key not in taken]
        say(f"{len(candidates)} candidates" + (f" beside {', '.join(sorted(taken))}" if taken else ""))
        if number or best.chi2 < TRACKED * best.rows.sum():
            fits = near(comparison, best, candidates)
        else:
            fits = race(comparison, best.model, *_failed(early, stops), candidates)
        if not fits or best.evidence - fits[0].evidence < LEAD_OVER_NOTHING:
            break
        say(f"refit with {fits[0].model.candidates[-1].key}")
        comparison = Comparison(runs, measured_whiteners(fits[0].model, fits[0].x))
        close = [solve(comparison, fit.model, fit.x) for fit in fits if fit.evidence < fits[0].evidence + CLOSE][:6]
        close = sorted((fit for fit in close if possible(fit)), key=lambda fit: fit.evidence)
        before = solve(comparison, best.model, best.x, turns=4)
        nominal = before if not rivals else solve(comparison, nominal.model, nominal.x, turns=4)
        close = [fit for fit in close if convincing(before, fit)]
        if rivals and before.held_chi2 < ADEQUATE:
            close = [fit for fit in close if not _is_free(fit)]
        if not close:
            best = before
            break
        rivals[close[0].model.candidates[-1].key] = tuple(
            (fit.evidence - close[0].evidence, fit.model.candidates[-1]) for fit in close[1:]
        )
        best = needed_only(comparison, close[0])
        if _is_free(best):
            break
    rounds = tuple(_round(comparison, nominal, best, each, rivals.get(each.key, ())) for each in best.model.candidates)
    return Search(comparison, nominal, best, rounds)


def _is_free(fit: Fit) -> bool:
    return fit.model.candidates[-1].term.effect in FREE


def needed_only(comparison: Comparison, fit: Fit) -> Fit:
    """The fit without the terms that a later one has made superfluous.

    A near relative may stand in for the true effect until that one is there to be chosen beside it.
    """
    for each in fit.model.candidates[:-1]:
        less = without(comparison, fit, each)
        if less.evidence - fit.evidence < LEAD_OVER_NOTHING:
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
    leads: tuple[tuple[float, Candidate], ...],
) -> Round:
    """What one term of the final fit does there."""
    alone = len(best.model.candidates) == 1
    return Round(candidate, nominal if alone else without(comparison, best, candidate), best, leads)


def with_hum(comparison: Comparison, fit: Fit) -> Fit:
    """The fit with hum of the one mains frequency that the recordings show, or of none."""
    fits = []
    for mains in ((), *((each,) for each in fit.model.mains)):
        model = Model(fit.model.runs, fit.model.device, fit.model.candidates, mains)
        fits.append(solve(comparison, model, model.embed(fit.model, fit.x), turns=3))
    return min(fits, key=lambda each: each.evidence)


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


def _failed(early: Sequence[Fit], stops: Sequence[float]) -> tuple[Fit, Sequence[float]]:
    """The first window over which the nominal model follows the motion worse than before, and those from there on."""
    levels = [fit.chi2 / fit.rows.sum() for fit in early]
    first = 0
    while first + 1 < len(levels) and levels[first] < 2.0 * min([TRACKED, *levels[:first]]):
        first += 1
    return early[first], stops[first:]
