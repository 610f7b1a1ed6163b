"""Fits of candidate terms in the full model, compared by evidence, and the test whether a term is significant."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from estimation.diagnosis.discrepancy import DISCREPANCY_TERMS
from estimation.diagnosis.fit import MAX_PARALLEL_FITS, Fit, Likelihood, fit_model, fit_models, linearise_at
from estimation.diagnosis.initial import estimate_whiteners
from estimation.diagnosis.model import Candidate, Model
from estimation.diagnosis.screening import (
    MIN_PREDICTED_GAIN,
    ScoreTest,
    damped_newton_start,
    score_candidate_starts,
    score_candidates,
)
from scanner.arrays import Array

DETECTION_THRESHOLD = 10.0
"""Fall of -2 log evidence from which a term is detected: a factor of 150 in probability, which leaves a margin for the
choice among some fifty candidates."""

COLOURED_NOISE_SAFETY_FACTOR = 2.5
"""Multiple of ``DETECTION_THRESHOLD`` that must remain of a gain if steeper slow noise explains most of it. In
simulations 17 to 22 remained for false drifts and at least 32 for true ones."""

UNIQUE_NAME_THRESHOLD = 6.0
"""Difference in -2 log evidence from which a term is reported as the only explanation: a factor of 20 in probability.
Within it, the next candidate is reported as a rival."""

MIN_VALIDATION_GAIN_RATIO = 0.3
"""Least gain in chi-square per held-out sample, as a ratio to the gain per fitted sample. A true effect gains nearly
the same on both; the rest allows for effects that act in part of the recording. ``DETECTION_THRESHOLD`` on held-out
samples always suffices."""

CHI2_LINEARISABLE = 2.0
"""Reduced chi-square up to which a fit has the phase of the motion right, so that the model is linear around it."""

NONLINEAR_GAIN = 100.0
"""Largest predicted fall of -2 log evidence above which predictions of first order no longer rank candidates."""

CHI2_ADEQUATE = 1.08
"""Reduced chi-square up to which a model is adequate. On fitted samples of a window: the candidate explains the misfit
there. On held-out samples: a discrepancy term beside named ones would only correct the form of their laws."""

BEAM_WIDTH = 6
"""Candidates that are continued over long windows: each more costs a fit over every remaining window."""

MAX_INITIAL_CANDIDATES = 12
"""Candidates of the score test that are fitted over the first window: twice ``BEAM_WIDTH``, for errors of its
ranking."""

MIN_SAMPLES_FOR_SHORTLIST = 1500
"""Fitted samples in the window of the score test from which only ``MAX_INITIAL_CANDIDATES`` are fitted. Over shorter
windows fits cost little, so all candidates are fitted."""

WINDOWS_PER_STEP = 5
"""Windows from the last that the nominal model fits to the first that it does not. A candidate's effect may set in
anywhere between."""

DIVERGENCE_RATIO = 3.0
"""Growth of the reduced chi-square from one window to the next that shows that the phase of the motion is lost."""

MAX_RATIO_AFTER_SPLIT = 0.95
"""Largest ratio of that growth after to before an intermediate window. Above it further intermediate windows are
useless."""

SPLIT_RATIO = 8.0
"""Growth of the reduced chi-square above which the first failing window is too long to linearise in. A shorter one is
then searched by bisection."""

MAX_WINDOW_SPLITS, MAX_WINDOW_SPLITS_SINGLE = 3, 12
"""Intermediate windows that may be inserted for all candidates together, and for a discrepancy term that is fitted
alone."""

MIN_WINDOW_RATIO = 1.03
"""Least ratio of successive windows: a window longer by 3 % adds too few samples to be worth a fit."""

PRUNE_MARGIN = 60.0
"""Difference in -2 log evidence within which candidates over a window are not pruned: over short windows the refitted
nominal values imitate any law."""

MIN_NOISE_CHI2 = 0.95
"""Lower bound on the reduced chi-square of pure noise. Used to bound from below the misfit on samples not yet
fitted."""

ABORT_MARGIN = 2000.0
"""Difference in -2 log evidence to the best fit above which a fit that no longer approaches it is aborted. It is large
against what late iterations gain."""

DUPLICATE_DISTANCE_SIGMA2 = 1.0
"""Squared distance [sigma²] of two fits of one candidate below which they have the same motion and one is dropped."""


def satisfies_sign_constraints(fit: Fit) -> bool:
    """Whether every parameter of the terms has a physically possible sign."""
    return all(
        f.parameter is None or f.parameter.sign * fit.x[i] >= 0.0
        for i, f in enumerate(fit.model.parameters)
        if f.kind == "term"
    )


def evidence_gain(likelihood: Likelihood, before: Fit, after: Fit) -> float:
    """Fall of -2 log evidence from ``before`` to ``after``, 0 below the detection threshold.

    The part that slow noise, rising more steeply than extrapolated, would also explain does not count.
    """
    excused = likelihood.low_frequency_excess_allowance(before) - likelihood.low_frequency_excess_allowance(after)
    lead = before.neg2_log_evidence - after.neg2_log_evidence - excused
    # the remainder is as uncertain as the steepness of slow noise
    return lead if lead >= DETECTION_THRESHOLD * (COLOURED_NOISE_SAFETY_FACTOR if excused > lead else 1.0) else 0.0


def is_significant(likelihood: Likelihood, before: Fit, after: Fit) -> bool:
    """Whether a term lowers -2 log evidence beyond the threshold and also improves the held-out samples.

    Where a term hardly acts on the held-out samples (it returns a nominal value to its prior, or it is a clip level
    that is reached at the start only), they need not improve, within the scatter of the change. Beside a clip level
    they must: slow noise is clipped with the signal and resembles an offset in the clipped periods.
    """
    lead = evidence_gain(likelihood, before, after)
    if not lead:
        return False
    gained = float(
        np.sum(before.residual[before.validation_rows] ** 2) - np.sum(after.residual[after.validation_rows] ** 2)
    )
    changed = float(np.sum((before.residual[before.validation_rows] - after.residual[after.validation_rows]) ** 2))
    fitted = before.chi2 - after.chi2
    unharmed = gained > -2.0 * np.sqrt(changed) - 2.0
    if fitted <= before.penalty - after.penalty:
        return unharmed
    share = min(
        MIN_VALIDATION_GAIN_RATIO * fitted * int(after.validation_rows.sum()) / int(after.rows.sum()),
        DETECTION_THRESHOLD,
    )
    beside_clip = any(each.term.after_noise for each in before.model.candidates)
    if changed < share:
        return unharmed and lead > 2.0 * DETECTION_THRESHOLD and not beside_clip
    if lead > (20.0 if before.model.candidates else 4.0) * DETECTION_THRESHOLD and not beside_clip:
        # Neither chance nor the form of another term's law gains so much. The expected gain on held-out samples is what
        # the term changes there, with a standard deviation of twice its square root.
        share = min(share, max(0.0, changed - 4.0 * np.sqrt(changed)))
    return gained > share


def fit_screened_candidates(likelihood: Likelihood, base: Fit, candidates: Sequence[Candidate]) -> list[Fit]:
    """Fits of the candidates with a predicted gain around ``base``; the best first.

    Discrepancy terms, which cost most, are fitted only if they gain beside the best named term.
    """
    promising = sorted(score_candidates(likelihood, base, candidates), key=lambda s: -s.predicted_gain)
    named, free = _split_discrepancy([each for each in promising if each.predicted_gain > MIN_PREDICTED_GAIN])
    return _fit_named_first(named, free, lambda part, bar: _fit_shortlist(likelihood, base, part))


def _split_discrepancy(screened: Sequence[ScoreTest]) -> tuple[list[ScoreTest], list[ScoreTest]]:
    """Named terms, and discrepancy terms."""
    free = [each for each in screened if each.candidate.term.effect in DISCREPANCY_TERMS]
    return [each for each in screened if each.candidate.term.effect not in DISCREPANCY_TERMS], free


def _fit_named_first(
    named: list[ScoreTest], free: list[ScoreTest], fitted: Callable[[list[ScoreTest], Fit | None], list[Fit]]
) -> list[Fit]:
    """Fits of named terms, and of discrepancy terms if they gain beside the best named term; the best first.

    Args:
        fitted: fits a list of candidates, given the best fit so far.
    """
    fits = fitted(named, None)
    best = min(fits, key=lambda fit: fit.neg2_log_evidence, default=None)
    if free and not (best is not None and _explains(best, [each.candidate for each in free])):
        fits += fitted(free, best)
    return sorted(fits, key=lambda fit: fit.neg2_log_evidence)


def _explains(fit: Fit, free: Sequence[Candidate]) -> bool:
    """Whether no discrepancy term has a predicted gain beside a fit, under the noise in the residual of the fit."""
    likelihood = Likelihood(fit.model.runs, estimate_whiteners(fit.model, fit.x))
    again = fit_model(likelihood, fit.model, fit.x, max_iterations=3)
    if again.chi2 > CHI2_LINEARISABLE * int(again.rows.sum()):
        return False
    return all(each.predicted_gain < DETECTION_THRESHOLD for each in score_candidates(likelihood, again, free))


def _fit_shortlist(likelihood: Likelihood, base: Fit, promising: Sequence[ScoreTest]) -> list[Fit]:
    """Fits, with possible signs, of the candidates with the largest predicted gains.

    Where the misfit is large, predictions may be wrong by a factor of ten either way. Then all candidates are fitted
    for a few iterations, and the worse half is dropped.
    """
    running = [(each.model, damped_newton_start(likelihood, base, each)) for each in promising]
    if promising and promising[0].predicted_gain > NONLINEAR_GAIN:
        for turns in (2, 3):
            fits = sorted(fit_models(likelihood, running, max_iterations=turns), key=lambda fit: fit.neg2_log_evidence)
            running = [(fit.model, fit.x) for fit in fits[: max(BEAM_WIDTH, len(fits) // 2)]]
        hopeless = (
            min((fit.neg2_log_evidence for fit in fits if satisfies_sign_constraints(fit)), default=np.inf)
            + ABORT_MARGIN
        )
    else:
        clear = [each for each in promising if each.predicted_gain > 0.5 * promising[0].predicted_gain]
        running, hopeless = running[: max(BEAM_WIDTH, len(clear))], np.inf
    return [fit for fit in fit_models(likelihood, running, abort_above=hopeless) if satisfies_sign_constraints(fit)]


def fit_candidates_progressively(
    likelihood: Likelihood,
    nominal: Model,
    early: Sequence[Fit],
    stops: Sequence[float],
    candidates: Sequence[Candidate],
) -> list[Fit]:
    """Fits of candidates over windows that grow from the last that the nominal model fits; the worst are dropped.

    The nominal model cannot be linearised once it has lost the phase of the motion. The score test is made over the
    first window that it fails to fit, where the phase error is still small. Fits start from the nominal values of the
    last window that it does fit, because a failing model distorts them.

    Args:
        early: fits of the nominal model over the windows ``stops``.
    """
    followed, reached, base, brink = _divergence_window(likelihood, nominal, early, stops)
    growing = [each for each in candidates if each.term.initial_seeds]
    others = [each for each in candidates if not each.term.initial_seeds]
    field = sorted(score_candidates(likelihood, base, others, brink), key=lambda each: -each.predicted_gain)
    choosy = base.rows.sum() > MIN_SAMPLES_FOR_SHORTLIST
    named, _ = _split_discrepancy(field)
    named = [
        each
        for i, each in enumerate(named)
        if not choosy or i < MAX_INITIAL_CANDIDATES or each.predicted_gain > 0.5 * field[0].predicted_gain
    ]
    named += _seed_self_excited(likelihood, nominal, followed, growing, brink)
    _, free = _split_discrepancy(field[:MAX_INITIAL_CANDIDATES])
    later = [stop for stop in stops if stop > brink]
    tracks = list(_refine_windows([reached, brink, *later])) if reached else [brink, *_refine_windows([brink, *later])]

    def through(part: list[ScoreTest], rival: Fit | None) -> list[Fit]:
        running = [
            (
                each.model,
                _init_from_last_good(each, followed) if reached else damped_newton_start(likelihood, base, each, brink),
            )
            for each in part
        ]
        if not any(each.candidate.term.effect in DISCREPANCY_TERMS for each in part):
            return _fit_over_windows(likelihood, running, tracks, reached, MAX_WINDOW_SPLITS)
        fits: list[Fit] = []
        for one in running:  # one by one: each may need its own intermediate windows
            fits += _fit_over_windows(likelihood, [one], tracks, reached, MAX_WINDOW_SPLITS_SINGLE, rival)
            rival = min([*fits, *([rival] if rival else [])], key=lambda fit: fit.neg2_log_evidence, default=None)
        return fits

    return _fit_named_first(named, free, through)


def _seed_self_excited(
    likelihood: Likelihood, nominal: Model, followed: Fit, growing: Sequence[Candidate], brink: float
) -> Iterator[ScoreTest]:
    """Score tests of self-excited modes, which are not linear around zero: the best start for every size of coupling.

    They use the nominal values of the last fitted window; values fitted over a longer one would imitate the mode.
    """
    straying = linearise_at(likelihood, nominal, nominal.map_parameters_from(followed.model, followed.x), brink)
    for starts in score_candidate_starts(likelihood, straying, growing, brink):
        size = starts[0].model.index("term", starts[0].candidate.key, starts[0].candidate.term.free_parameters[0].name)
        for each in {start.x[size]: start for start in sorted(starts, key=lambda start: start.predicted_gain)}.values():
            if each.predicted_gain > MIN_PREDICTED_GAIN:
                yield each


class DivergenceWindow(NamedTuple):
    """The windows between which a model loses the phase of the motion.

    Attributes:
        followed: its fit over the longest window ``reached`` that it follows (0 for none, and the first window's fit).
        failing: its fit over the window ``stop``, over which it fails, but not by far.
    """

    followed: Fit
    reached: float
    failing: Fit
    stop: float


def _divergence_window(
    likelihood: Likelihood, model: Model, early: Sequence[Fit], stops: Sequence[float]
) -> DivergenceWindow:
    """The two windows between which ``model`` fails, found among ``stops`` and refined by bisection."""
    first = _first_divergent(early)
    followed, reached, stop = early[max(first - 1, 0)], stops[first - 1] if first else 0.0, stops[first]
    failing = fit_model(likelihood, model, model.map_parameters_from(early[first].model, early[first].x), stop, 8)
    for later in stops[first + 1 :]:
        if _reduced_chi2(failing) > CHI2_ADEQUATE:
            break
        # under the estimated noise the model may fit a window that it failed to fit under the first guess
        followed, reached, stop = failing, stop, later
        failing = fit_model(likelihood, model, failing.x, stop, 8)
    while (
        _reduced_chi2(failing) > SPLIT_RATIO * max(_reduced_chi2(followed), 1.0)
        and stop > MIN_WINDOW_RATIO**2 * reached > 0.0
    ):
        middle = float(np.sqrt(reached * stop))
        fit = fit_model(likelihood, model, model.map_parameters_from(followed.model, followed.x), middle, 8)
        if _reduced_chi2(fit) < 2.0 * _reduced_chi2(followed):
            followed, reached = fit, middle
        else:
            failing, stop = fit, middle
    return DivergenceWindow(followed, reached, failing, stop)


def _fit_over_windows(
    likelihood: Likelihood,
    running: list[tuple[Model, Array]],
    stops: Sequence[float],
    reached: float,
    splits: int,
    rival: Fit | None = None,
) -> list[Fit]:
    """Fits over the growing windows ``stops``, with possible signs; the worst are dropped on the way.

    If a window extends the previous one by too much, the phase error exceeds half a cycle and the fit converges to a
    wrong minimum. Shorter intermediate windows are then inserted, as long as that helps.

    Args:
        reached: window up to which they start as good fits, 0 for none.
        splits: windows that may be put in between.
        rival: competing fit over the whole recording.
    """
    ahead, level, bar = list(stops)[::-1], 1.0, np.inf if rival is None else rival.neg2_log_evidence
    fits: list[Fit] = []
    lost_at: dict[float, float] = {}
    while running and ahead:
        stop = ahead[-1]
        turns, tolerance = (14, 0.05) if stop == stops[-1] else (8, 1.0)
        fits = []
        for first in range(0, len(running), MAX_PARALLEL_FITS):
            best = min(
                (fit.neg2_log_evidence for fit in fits if satisfies_sign_constraints(fit)), default=bar - ABORT_MARGIN
            )
            some = running[first : first + MAX_PARALLEL_FITS]
            fits += fit_models(likelihood, some, stop, turns, tolerance, abort_above=best + ABORT_MARGIN)
        fits.sort(key=lambda fit: (not satisfies_sign_constraints(fit), fit.neg2_log_evidence))
        now = _reduced_chi2(fits[0])
        lost = level < CHI2_LINEARISABLE and now > DIVERGENCE_RATIO * max(level, 1.0)
        if (
            lost
            and splits
            and stop > MIN_WINDOW_RATIO * reached > 0.0
            and now < MAX_RATIO_AFTER_SPLIT * lost_at.get(stop, np.inf)
        ):
            ahead.append(float(np.sqrt(reached * stop)))
            lost_at[stop] = now
            splits -= 1
            continue
        if fits[0].chi2 > bar or (stop >= stops[:WINDOWS_PER_STEP][-1] and _dominated(likelihood, fits[0], rival)):
            return []
        reached, level = ahead.pop(), now
        if len(fits) <= BEAM_WIDTH or fits[BEAM_WIDTH].neg2_log_evidence > fits[0].neg2_log_evidence + PRUNE_MARGIN:
            running = _prune(list(_deduplicate(fits)), now > CHI2_ADEQUATE, 4 * stop > stops[-1])
        # otherwise no candidate is distinguished yet, and all continue from their previous start
    # only the best fit of a candidate with several starts
    best_of = {fit.model.candidates[-1].key: fit for fit in reversed(fits) if satisfies_sign_constraints(fit)}
    return list(best_of.values())


def _deduplicate(fits: Sequence[Fit]) -> Iterator[Fit]:
    """Fits, sorted by quality, without those whose residual equals that of a better fit of the same candidate."""
    met: dict[str, list[Fit]] = {}
    for fit in fits:
        others = met.setdefault(fit.model.candidates[-1].key, [])
        if all(
            np.sum((fit.residual[fit.rows] - other.residual[other.rows]) ** 2) > DUPLICATE_DISTANCE_SIGMA2
            for other in others
        ):
            others.append(fit)
            yield fit


def _dominated(likelihood: Likelihood, fit: Fit, rival: Fit | None) -> bool:
    """Whether a fit over a window is worse than ``rival`` even if only noise remained outside the window."""
    if rival is None:
        return False
    unseen = likelihood.rows & ~fit.rows
    rest = min(float(np.sum(rival.residual[unseen] ** 2)), MIN_NOISE_CHI2 * int(unseen.sum()))
    return fit.chi2 + rest > rival.neg2_log_evidence + ABORT_MARGIN


def _prune(fits: list[Fit], unexplained: bool, few: bool) -> list[tuple[Model, Array]]:
    """Models and starts that are continued over the next window, by evidence or the first few.

    Args:
        unexplained: even the best fit explains little, so the order means little.
        few: at most ``BEAM_WIDTH``.
    """
    best, worst = fits[0].neg2_log_evidence, max(fit.neg2_log_evidence for fit in fits)
    margin = max(PRUNE_MARGIN, 0.5 * (worst - best))
    # adequate fits are continued whatever their evidence: over a short window nominal values imitate any law
    kept = [fit for fit in fits if fit.neg2_log_evidence < best + margin or _reduced_chi2(fit) < CHI2_ADEQUATE]
    if unexplained:
        kept = fits[: max(BEAM_WIDTH, len(kept))]
    # The best fits with an impossible sign are continued with the opposite sign: a ringing mode fits with both.
    mirrored = [
        (fit.model, _flip_sign(fit))
        for fit in fits
        if not satisfies_sign_constraints(fit) and fit.neg2_log_evidence <= best
    ]
    kept = [fit for fit in kept if satisfies_sign_constraints(fit) or fit.neg2_log_evidence > best]
    return mirrored + [(fit.model, fit.x) for fit in (kept[:BEAM_WIDTH] if few else kept)]


def _flip_sign(fit: Fit) -> Array:
    """Parameters of a fit with the sign of the last term's amplitudes corrected and its hidden states negated."""
    key, x = fit.model.candidates[-1].key, fit.x.copy()
    for i, f in enumerate(fit.model.parameters):
        if f.owner == key and (f.kind == "hidden" or (f.parameter is not None and f.parameter.sign * x[i] < 0.0)):
            x[i] = -x[i]
    return x


def _reduced_chi2(fit: Fit) -> float:
    """Reduced chi-square over the window of a fit."""
    return fit.chi2 / int(fit.rows.sum())


def _first_divergent(early: Sequence[Fit]) -> int:
    """Index of the first window over which the fit of the nominal model is clearly worse than before."""
    levels = [_reduced_chi2(fit) for fit in early]
    first = 0
    while first + 1 < len(levels) and levels[first] < 2.0 * min([CHI2_LINEARISABLE, *levels[:first]]):
        first += 1
    return first


def _refine_windows(stops: Sequence[float]) -> Iterator[float]:
    """Windows after the first of ``stops``, with intermediate ones.

    Most are inserted before the first window that the nominal model fails to fit, where the effect may set in.
    """
    for i, (low, high) in enumerate(pairwise(stops)):
        yield from np.geomspace(low, high, (WINDOWS_PER_STEP if i == 0 else 2) + 1)[1:-1].tolist()
        yield high


def _init_from_last_good(each: ScoreTest, followed: Fit) -> Array:
    """Start of a candidate: the nominal values of the last fitted window, and the term as in its score test."""
    x = each.model.map_parameters_from(followed.model, followed.x)
    own = [f.owner == each.candidate.key for f in each.model.parameters]
    x[own] = each.x[own]
    return x
