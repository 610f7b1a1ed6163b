"""Which physics is missing: every candidate fitted inside the full model, compared by evidence."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimation.mismatch.fit import ABREAST, Comparison, Fit, solve, solve_all, unmoved
from estimation.mismatch.free import FREE
from estimation.mismatch.model import Candidate, Model
from estimation.mismatch.screen import PROMISING, Screened, from_starts, screen, stepped
from estimation.mismatch.start import measured_whiteners

Array = NDArray[np.float64]

LEAD_OVER_NOTHING = 10.0
"""Fall of -2 log evidence from which a term is said to be there at all."""

DOUBTFUL = 2.5
"""Times ``LEAD_OVER_NOTHING`` that must be left of a lead most of which steeper slow noise explains: of false drifts
17 to 22 were left, of true ones 32 and more."""

LEAD_OVER_NEXT = 6.0
"""Lead from which a term is named alone; within it, the next is named beside it."""

SHARE_HELD = 0.3
"""Of what a term gains where it was fitted, the least that it must gain, sample for sample, where it was not; a gain of
``LEAD_OVER_NOTHING`` there is enough of any."""

TRACKED = 2.0
"""Reduced chi-square up to which a fit follows the motion, so that first order holds around it."""

MUCH = 100.0
"""Fall of -2 log evidence beyond which first order is no judge of candidates."""

EXPLAINED = 1.08
"""Reduced chi-square over a window up to which a candidate has explained what went wrong in it."""

FINALISTS = 6
STARTERS = 12

MANY_SAMPLES = 1500
"""From here on only ``STARTERS`` start: over a window so short that it has fewer, all may, and cost little."""

EASE = 5
"""Windows from the last that the nominal model follows to the first that it does not."""

LOST = 3.0
"""Growth of the reduced chi-square, from one window to the next, by which the motion has been lost."""

AGAIN = 0.95
"""Share of what it was, to which a window in between must have brought that growth for another to be worth while."""

FAR = 8.0
"""Growth of it from which the model is no longer about to lose the motion: a window in between tells more."""

TOGETHER, ALONE = 3, 12
"""Windows that may be put in between for all, and for one free correction that runs alone."""

FINEST = 1.03
"""Least growth of a window."""

NO_VERDICT = 60.0
"""Lead in -2 log evidence that over a window, or between many, says nothing yet."""

QUIET = 0.95
"""Reduced chi-square that noise alone, as it was measured, does not stay below."""

HOPELESS = 2000.0
"""A fit that is this far behind another's evidence after a few turns is not polished."""

SAME = 1.0
"""Square of the distance, in sigma, within which two motions of one candidate over a window are one."""


def possible(fit: Fit) -> bool:
    """Whether every parameter has a sign that physics allows."""
    return all(
        f.parameter is None or f.parameter.sign * fit.x[i] >= 0.0
        for i, f in enumerate(fit.model.free)
        if f.kind == "term"
    )


def lead_of(comparison: Comparison, before: Fit, after: Fit) -> float:
    """By how much -2 log evidence falls, 0 where that is not well ahead of nothing.

    What slow noise would explain as well, if it rises more steeply than it was continued, is no lead.
    """
    excused = comparison.excused(before) - comparison.excused(after)
    lead = before.evidence - after.evidence - excused
    # what is left beside an excuse is known no better than how steeply slow noise rises
    return lead if lead >= LEAD_OVER_NOTHING * (DOUBTFUL if excused > lead else 1.0) else 0.0


def convincing(comparison: Comparison, before: Fit, after: Fit) -> bool:
    """Whether a term is there: well ahead of nothing, and better on samples that no fit has seen.

    Where held-out samples hardly show a term (a nominal value pulled off that it relieves, a clip level reached in the
    first turns only), they may stay as they were, within the scatter of what it changes there. Beside a clip level they
    may not: slow noise is clipped with the signal, and looks like an offset in the turns that are.
    """
    lead = lead_of(comparison, before, after)
    if not lead:
        return False
    gained = float(np.sum(before.residual[before.held] ** 2) - np.sum(after.residual[after.held] ** 2))
    changed = float(np.sum((before.residual[before.held] - after.residual[after.held]) ** 2))
    fitted = before.chi2 - after.chi2
    unharmed = gained > -2.0 * np.sqrt(changed) - 2.0
    if fitted <= before.penalty - after.penalty:
        return unharmed
    share = min(SHARE_HELD * fitted * int(after.held.sum()) / int(after.rows.sum()), LEAD_OVER_NOTHING)
    beside_clip = any(each.term.at_output for each in before.model.candidates)
    if changed < share:
        return unharmed and lead > 2.0 * LEAD_OVER_NOTHING and not beside_clip
    if lead > (20.0 if before.model.candidates else 4.0) * LEAD_OVER_NOTHING and not beside_clip:
        # No chance leads by so much, nor how another term's law was written down: it has to gain what it may, which
        # scatters by twice the root of what it changes.
        share = min(share, max(0.0, changed - 4.0 * np.sqrt(changed)))
    return gained > share


def near(comparison: Comparison, base: Fit, candidates: Sequence[Candidate]) -> list[Fit]:
    """Fits of the candidates that first order around ``base`` promises anything of, best first.

    Free corrections, which cost most, are fitted only where they find something beside the best named term.
    """
    promising = sorted(screen(comparison, base, candidates), key=lambda s: -s.gain)
    named, free = _apart([each for each in promising if each.gain > PROMISING])
    return _named_first(named, free, lambda part, bar: _finalists(comparison, base, part))


def _apart(screened: Sequence[Screened]) -> tuple[list[Screened], list[Screened]]:
    """Named terms, and free corrections."""
    free = [each for each in screened if each.candidate.term.effect in FREE]
    return [each for each in screened if each.candidate.term.effect not in FREE], free


def _named_first(
    named: list[Screened], free: list[Screened], fitted: Callable[[list[Screened], Fit | None], list[Fit]]
) -> list[Fit]:
    """Fits of named terms, and of free corrections too unless they find nothing beside the best name; best first.

    Args:
        fitted: told which, and the fit that is there to be beaten.
    """
    fits = fitted(named, None)
    best = min(fits, key=lambda fit: fit.evidence, default=None)
    if free and not (best is not None and _explains(best, [each.candidate for each in free])):
        fits += fitted(free, best)
    return sorted(fits, key=lambda fit: fit.evidence)


def _explains(fit: Fit, free: Sequence[Candidate]) -> bool:
    """Whether no ``free`` correction gains by first order beside a fit, under the noise that the fit leaves."""
    comparison = Comparison(fit.model.runs, measured_whiteners(fit.model, fit.x))
    again = solve(comparison, fit.model, fit.x, turns=3)
    if again.chi2 > TRACKED * int(again.rows.sum()):
        return False
    return all(each.gain < LEAD_OVER_NOTHING for each in screen(comparison, again, free))


def _finalists(comparison: Comparison, base: Fit, promising: Sequence[Screened]) -> list[Fit]:
    """Possible fits of what is promised most.

    Where much is missing, first order promises one ten times too little and the other ten times too much: all take a
    step or two, and those that lag far behind drop out.
    """
    running = [(each.model, stepped(comparison, base, each)) for each in promising]
    if promising and promising[0].gain > MUCH:
        for turns in (2, 3):
            fits = sorted(solve_all(comparison, running, turns=turns), key=lambda fit: fit.evidence)
            running = [(fit.model, fit.x) for fit in fits[: max(FINALISTS, len(fits) // 2)]]
        hopeless = min((fit.evidence for fit in fits if possible(fit)), default=np.inf) + HOPELESS
    else:
        clear = [each for each in promising if each.gain > 0.5 * promising[0].gain]
        running, hopeless = running[: max(FINALISTS, len(clear))], np.inf
    return [fit for fit in solve_all(comparison, running, hopeless=hopeless) if possible(fit)]


def race(
    comparison: Comparison,
    nominal: Model,
    early: Sequence[Fit],
    stops: Sequence[float],
    candidates: Sequence[Candidate],
) -> list[Fit]:
    """Fits of candidates that grow window by window from where the nominal model still follows; laggards drop out.

    A nominal model that has lost the motion's phase is nothing to linearise around, the one that is about to is: first
    order there says who may start. They start from where nothing was lost yet: what a failing model does to the nominal
    values leads astray.

    Args:
        early: fits of the nominal model over the windows ``stops``.
    """
    followed, reached, base, brink = _brink(comparison, nominal, early, stops)
    growing = [each for each in candidates if each.term.seeds]
    others = [each for each in candidates if not each.term.seeds]
    field = sorted(screen(comparison, base, others, brink), key=lambda each: -each.gain)
    choosy = base.rows.sum() > MANY_SAMPLES
    named, _ = _apart(field)
    named = [each for i, each in enumerate(named) if not choosy or i < STARTERS or each.gain > 0.5 * field[0].gain]
    named += _sown(comparison, nominal, followed, growing, brink)
    _, free = _apart(field[:STARTERS])
    later = [stop for stop in stops if stop > brink]
    tracks = list(_eased([reached, brink, *later])) if reached else [brink, *_eased([brink, *later])]

    def through(part: list[Screened], rival: Fit | None) -> list[Fit]:
        running = [
            (each.model, _unspoilt(each, followed) if reached else stepped(comparison, base, each, brink))
            for each in part
        ]
        if not any(each.candidate.term.effect in FREE for each in part):
            return _raced(comparison, running, tracks, reached, TOGETHER)
        fits: list[Fit] = []
        for one in running:  # few, and where one has lost the motion another may follow
            fits += _raced(comparison, [one], tracks, reached, ALONE, rival)
            rival = min([*fits, *([rival] if rival else [])], key=lambda fit: fit.evidence, default=None)
        return fits

    return _named_first(named, free, through)


def _sown(
    comparison: Comparison, nominal: Model, followed: Fit, growing: Sequence[Candidate], brink: float
) -> Iterator[Screened]:
    """Modes that grow from next to nothing, for which no first order holds: the best start for every size of coupling.

    Around the nominal values that follow as yet: values bent to what a mode does over the window imitate it.
    """
    straying = unmoved(comparison, nominal, nominal.embed(followed.model, followed.x), brink)
    for starts in from_starts(comparison, straying, growing, brink):
        size = starts[0].model.index("term", starts[0].candidate.key, starts[0].candidate.term.free[0].name)
        for each in {start.x[size]: start for start in sorted(starts, key=lambda start: start.gain)}.values():
            if each.gain > PROMISING:
                yield each


class Brink(NamedTuple):
    """Where a model begins to lose the motion.

    Attributes:
        followed: its fit over the longest window ``reached`` that it follows (0 for none, and the first window's fit).
        failing: its fit over the window ``stop``, over which it fails, but not by far.
    """

    followed: Fit
    reached: float
    failing: Fit
    stop: float


def _brink(comparison: Comparison, model: Model, early: Sequence[Fit], stops: Sequence[float]) -> Brink:
    """Of windows that grow by large steps the two between which ``model`` fails, and windows between these."""
    first = _failing(early)
    followed, reached, stop = early[max(first - 1, 0)], stops[first - 1] if first else 0.0, stops[first]
    failing = solve(comparison, model, model.embed(early[first].model, early[first].x), stop, 8)
    for later in stops[first + 1 :]:
        if _level(failing) > EXPLAINED:
            break
        # what failed under the noise first guessed does not under the noise as measured
        followed, reached, stop = failing, stop, later
        failing = solve(comparison, model, failing.x, stop, 8)
    while _level(failing) > FAR * max(_level(followed), 1.0) and stop > FINEST**2 * reached > 0.0:
        middle = float(np.sqrt(reached * stop))
        fit = solve(comparison, model, model.embed(followed.model, followed.x), middle, 8)
        if _level(fit) < 2.0 * _level(followed):
            followed, reached = fit, middle
        else:
            failing, stop = fit, middle
    return Brink(followed, reached, failing, stop)


def _raced(
    comparison: Comparison,
    running: list[tuple[Model, Array]],
    stops: Sequence[float],
    reached: float,
    splits: int,
    rival: Fit | None = None,
) -> list[Fit]:
    """Possible fits of those that keep up through the growing windows ``stops``.

    Where all lose the motion, windows are put in between, as long as that helps: after too long a stretch of what a law
    has not seen yet, no step leads back.

    Args:
        reached: window up to which they start as good fits, 0 for none.
        splits: windows that may be put in between.
        rival: fit of the whole that is there to be beaten.
    """
    ahead, level, bar = list(stops)[::-1], 1.0, np.inf if rival is None else rival.evidence
    fits: list[Fit] = []
    lost_at: dict[float, float] = {}
    while running and ahead:
        stop = ahead[-1]
        turns, tolerance = (14, 0.05) if stop == stops[-1] else (8, 1.0)
        fits = []
        for first in range(0, len(running), ABREAST):
            best = min((fit.evidence for fit in fits if possible(fit)), default=bar - HOPELESS)
            some = running[first : first + ABREAST]
            fits += solve_all(comparison, some, stop, turns, tolerance, hopeless=best + HOPELESS)
        fits.sort(key=lambda fit: (not possible(fit), fit.evidence))
        now = _level(fits[0])
        lost = level < TRACKED and now > LOST * max(level, 1.0)
        if lost and splits and stop > FINEST * reached > 0.0 and now < AGAIN * lost_at.get(stop, np.inf):
            ahead.append(float(np.sqrt(reached * stop)))
            lost_at[stop] = now
            splits -= 1
            continue
        if fits[0].chi2 > bar or (stop >= stops[:EASE][-1] and _beaten(comparison, fits[0], rival)):
            return []
        reached, level = ahead.pop(), now
        if len(fits) <= FINALISTS or fits[FINALISTS].evidence > fits[0].evidence + NO_VERDICT:
            running = _kept(list(_distinct(fits)), now > EXPLAINED, 4 * stop > stops[-1])
        # else nothing has shown: all go on as they came, a mode that will grow with what it grows from
    # the best alone of a candidate that ran from several starts
    best_of = {fit.model.candidates[-1].key: fit for fit in reversed(fits) if possible(fit)}
    return list(best_of.values())


def _distinct(fits: Sequence[Fit]) -> Iterator[Fit]:
    """Of fits, the best first, those whose motion another start of the same candidate has not led to already."""
    met: dict[str, list[Fit]] = {}
    for fit in fits:
        others = met.setdefault(fit.model.candidates[-1].key, [])
        if all(np.sum((fit.residual[fit.rows] - other.residual[other.rows]) ** 2) > SAME for other in others):
            others.append(fit)
            yield fit


def _beaten(comparison: Comparison, fit: Fit, rival: Fit | None) -> bool:
    """Whether a fit over a window misses more there than ``rival`` in all, were there but noise to come."""
    if rival is None:
        return False
    unseen = comparison.rows & ~fit.rows
    rest = min(float(np.sum(rival.residual[unseen] ** 2)), QUIET * int(unseen.sum()))
    return fit.chi2 + rest > rival.evidence + HOPELESS


def _kept(fits: list[Fit], unexplained: bool, few: bool) -> list[tuple[Model, Array]]:
    """Those of a race, the best first, that run on: by their evidence, or the first few.

    Args:
        unexplained: even the best explains little yet: being ahead is no merit.
        few: at most ``FINALISTS``.
    """
    best, worst = fits[0].evidence, max(fit.evidence for fit in fits)
    margin = max(NO_VERDICT, 0.5 * (worst - best))
    # who explains as well stays, whatever it costs: over a short window nominal values bend to any law
    kept = [fit for fit in fits if fit.evidence < best + margin or _level(fit) < EXPLAINED]
    if unexplained:
        kept = fits[: max(FINALISTS, len(kept))]
    # What leads with a sign that physics forbids goes on with the other: a ringing mode fits with both.
    mirrored = [(fit.model, _mirrored(fit)) for fit in fits if not possible(fit) and fit.evidence <= best]
    kept = [fit for fit in kept if possible(fit) or fit.evidence > best]
    return mirrored + [(fit.model, fit.x) for fit in (kept[:FINALISTS] if few else kept)]


def _mirrored(fit: Fit) -> Array:
    """Its free numbers, the newest term's amplitudes with the sign that physics allows, its hidden states turned."""
    key, x = fit.model.candidates[-1].key, fit.x.copy()
    for i, f in enumerate(fit.model.free):
        if f.owner == key and (f.kind == "hidden" or (f.parameter is not None and f.parameter.sign * x[i] < 0.0)):
            x[i] = -x[i]
    return x


def _level(fit: Fit) -> float:
    """Reduced chi-square over the window of a fit."""
    return fit.chi2 / int(fit.rows.sum())


def _failing(early: Sequence[Fit]) -> int:
    """The first window over which the nominal model follows the motion worse than before."""
    levels = [_level(fit) for fit in early]
    first = 0
    while first + 1 < len(levels) and levels[first] < 2.0 * min([TRACKED, *levels[:first]]):
        first += 1
    return first


def _eased(stops: Sequence[float]) -> Iterator[float]:
    """Windows after the first of ``stops``, with some in between: a law is added where a little has gone wrong.

    Many on the way to the first window that the nominal model does not follow: anywhere there the law may set in.
    """
    for i, (low, high) in enumerate(pairwise(stops)):
        yield from np.geomspace(low, high, (EASE if i == 0 else 2) + 1)[1:-1].tolist()
        yield high


def _unspoilt(each: Screened, followed: Fit) -> Array:
    """Where a candidate starts: the nominal values of the last window that was followed, its law not there yet."""
    x = each.model.embed(followed.model, followed.x)
    own = [f.owner == each.candidate.key for f in each.model.free]
    x[own] = each.x[own]
    return x
