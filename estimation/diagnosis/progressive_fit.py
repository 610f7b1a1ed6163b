"""Fits of candidate terms in the full model, over windows of increasing length, compared by evidence."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from estimation.diagnosis.discrepancy import DISCREPANCY_TERMS
from estimation.diagnosis.fit import MAX_PARALLEL_FITS, Fit, Likelihood, fit_model, fit_models, linearise_at
from estimation.diagnosis.initial import estimate_whiteners
from estimation.diagnosis.model import Model
from estimation.diagnosis.parameters import Candidate
from estimation.diagnosis.screening import (
    MIN_PREDICTED_GAIN,
    ScoreTest,
    damped_newton_start,
    score_candidate_starts,
    score_candidates,
)
from estimation.diagnosis.significance import DETECTION_THRESHOLD, satisfies_sign_constraints
from estimation.diagnosis.windows import (
    CHI2_ADEQUATE,
    CHI2_LINEARISABLE,
    MIN_WINDOW_RATIO,
    WINDOWS_PER_STEP,
    divergence_window,
    reduced_chi2,
    refine_windows,
)
from scanner.arrays import Array

NONLINEAR_GAIN = 100.0
"""Largest predicted fall of -2 log evidence above which predictions of first order no longer rank candidates."""


BEAM_WIDTH = 6
"""Number of candidates that are continued over long windows. Each of them costs a fit over every remaining window."""

MAX_INITIAL_CANDIDATES = 12
"""Number of candidates that are fitted over the first window: twice ``BEAM_WIDTH``, because the ranking by the score
test is not exact."""

MIN_SAMPLES_FOR_SHORTLIST = 1500
"""Fitted samples in the window of the score test from which only ``MAX_INITIAL_CANDIDATES`` are fitted. Over shorter
windows fits cost little, so all candidates are fitted."""


DIVERGENCE_RATIO = 3.0
"""Ratio of the reduced chi-squares of successive windows above which the phase error has exceeded half a cycle."""

MAX_RATIO_AFTER_SPLIT = 0.95
"""Ratio of the reduced chi-square of a window after an intermediate window was inserted to that before. Above it, no
further intermediate window is inserted."""


MAX_WINDOW_SPLITS, MAX_WINDOW_SPLITS_SINGLE = 3, 12
"""Largest number of inserted intermediate windows: in the fits of all candidates together, and in the fit of a single
discrepancy term, which needs more. They bound the computing time."""


PRUNE_MARGIN = 60.0
"""Difference in -2 log evidence to the best candidate up to which a candidate is continued over the next window. Over
short windows the refitted nominal values explain nearly the same as any law, so that differences are small."""

MIN_NOISE_CHI2 = 0.95
"""Lower bound on the reduced chi-square of pure noise. Used to bound from below the misfit on samples not yet
fitted."""

ABORT_MARGIN = 2000.0
"""Difference in -2 log evidence to the best fit above which a fit that no longer approaches it is aborted. Later
iterations gain far less."""

DUPLICATE_DISTANCE_SIGMA2 = 1.0
"""Squared distance [sigma²] of two fits of one candidate below which they have the same motion and one is dropped."""


Settles = Callable[[Fit], bool]
"""Whether a fit of a named term needs no comparison with fits of discrepancy terms."""


def fit_screened_candidates(
    likelihood: Likelihood, base: Fit, candidates: Sequence[Candidate], settles: Settles = lambda fit: False
) -> list[Fit]:
    """Fits of the candidates with a predicted gain around ``base``; the best first.

    Discrepancy terms, which cost most, are fitted only if they gain beside the best named term.
    """
    promising = sorted(score_candidates(likelihood, base, candidates), key=lambda s: -s.predicted_gain)
    named, free = _split_discrepancy([score for score in promising if score.predicted_gain > MIN_PREDICTED_GAIN])
    return _fit_named_first(named, free, lambda part, bar: _fit_shortlist(likelihood, base, part), settles)


def _split_discrepancy(screened: Sequence[ScoreTest]) -> tuple[list[ScoreTest], list[ScoreTest]]:
    """Named terms, and discrepancy terms."""
    free = [score for score in screened if score.candidate.term.effect in DISCREPANCY_TERMS]
    return [score for score in screened if score.candidate.term.effect not in DISCREPANCY_TERMS], free


def _fit_named_first(
    named: list[ScoreTest],
    free: list[ScoreTest],
    fitted: Callable[[list[ScoreTest], Fit | None], list[Fit]],
    settles: Settles,
) -> list[Fit]:
    """Fits of named terms, and of discrepancy terms if they gain beside the best named term; the best first.

    Args:
        fitted: fits a list of candidates, given the best fit so far.
        settles: whether the best named term leads to laws that need no discrepancy term.
    """
    fits = fitted(named, None)
    best = min(fits, key=lambda fit: fit.neg2_log_evidence, default=None)
    if free and not (best is not None and (_explains(best, [score.candidate for score in free]) or settles(best))):
        fits += fitted(free, best)
    return sorted(fits, key=lambda fit: fit.neg2_log_evidence)


def _explains(fit: Fit, free: Sequence[Candidate]) -> bool:
    """Whether no discrepancy term has a predicted gain beside a fit, under the noise in the residual of the fit."""
    likelihood = Likelihood(fit.model.runs, estimate_whiteners(fit.model, fit.x))
    again = fit_model(likelihood, fit.model, fit.x, max_iterations=3)
    if again.chi2 > CHI2_LINEARISABLE * int(again.rows.sum()):
        return False
    return all(score.predicted_gain < DETECTION_THRESHOLD for score in score_candidates(likelihood, again, free))


def _fit_shortlist(likelihood: Likelihood, base: Fit, promising: Sequence[ScoreTest]) -> list[Fit]:
    """Fits, with possible signs, of the candidates with the largest predicted gains.

    If the misfit is large, predicted gains may be wrong by a factor of ten. Then all candidates are fitted for a few
    iterations, and the worse half is dropped.
    """
    starts = [(score.model, damped_newton_start(likelihood, base, score)) for score in promising]
    if promising and promising[0].predicted_gain > NONLINEAR_GAIN:
        for max_iterations in (2, 3):
            fits = sorted(
                fit_models(likelihood, starts, max_iterations=max_iterations), key=lambda fit: fit.neg2_log_evidence
            )
            starts = [(fit.model, fit.x) for fit in fits[: max(BEAM_WIDTH, len(fits) // 2)]]
        abort_above = (
            min((fit.neg2_log_evidence for fit in fits if satisfies_sign_constraints(fit)), default=np.inf)
            + ABORT_MARGIN
        )
    else:
        competitive = [score for score in promising if score.predicted_gain > 0.5 * promising[0].predicted_gain]
        starts, abort_above = starts[: max(BEAM_WIDTH, len(competitive))], np.inf
    return [fit for fit in fit_models(likelihood, starts, abort_above=abort_above) if satisfies_sign_constraints(fit)]


def fit_candidates_progressively(
    likelihood: Likelihood,
    nominal: Model,
    early: Sequence[Fit],
    stops: Sequence[float],
    candidates: Sequence[Candidate],
    settles: Settles = lambda fit: False,
) -> list[Fit]:
    """Fits of candidates over growing windows, from the last one that the nominal model fits; the worst are dropped.

    Where the phase error of the nominal model is large, the model cannot be linearised. The score test therefore uses
    the first window that the nominal model does not fit, where its phase error is still small. Fits start from the
    nominal values of the last window that it fits, because later fits of the nominal model have wrong values.

    Args:
        early: fits of the nominal model over the windows ``stops``.
    """
    last_good, reached, base, failing_stop = divergence_window(likelihood, nominal, early, stops)
    self_excited = [score for score in candidates if score.term.initial_seeds]
    linear_candidates = [score for score in candidates if not score.term.initial_seeds]
    scores = sorted(
        score_candidates(likelihood, base, linear_candidates, failing_stop), key=lambda score: -score.predicted_gain
    )
    is_shortlisted = base.rows.sum() > MIN_SAMPLES_FOR_SHORTLIST
    named, _ = _split_discrepancy(scores)
    named = [
        score
        for i, score in enumerate(named)
        if not is_shortlisted or i < MAX_INITIAL_CANDIDATES or score.predicted_gain > 0.5 * scores[0].predicted_gain
    ]
    named += _seed_self_excited(likelihood, nominal, last_good, self_excited, failing_stop)
    _, free = _split_discrepancy(scores[:MAX_INITIAL_CANDIDATES])
    later = [stop for stop in stops if stop > failing_stop]
    windows = (
        list(refine_windows([reached, failing_stop, *later]))
        if reached
        else [failing_stop, *refine_windows([failing_stop, *later])]
    )

    def through(part: list[ScoreTest], rival: Fit | None) -> list[Fit]:
        running = [
            (
                score.model,
                _init_from_last_good(score, last_good)
                if reached
                else damped_newton_start(likelihood, base, score, failing_stop),
            )
            for score in part
        ]
        if not any(score.candidate.term.effect in DISCREPANCY_TERMS for score in part):
            return _fit_over_windows(likelihood, running, windows, reached, MAX_WINDOW_SPLITS)
        fits: list[Fit] = []
        for start in running:  # one by one: each may need its own intermediate windows
            fits += _fit_over_windows(likelihood, [start], windows, reached, MAX_WINDOW_SPLITS_SINGLE, rival)
            rival = min([*fits, *([rival] if rival else [])], key=lambda fit: fit.neg2_log_evidence, default=None)
        return fits

    return _fit_named_first(named, free, through, settles)


def _seed_self_excited(
    likelihood: Likelihood, nominal: Model, last_good: Fit, self_excited: Sequence[Candidate], stop: float
) -> Iterator[ScoreTest]:
    """Score tests of self-excited modes, which are not linear around zero: the best start for every size of coupling.

    They use the nominal values of the last window that the nominal model fits; values of a longer window would explain
    a part of the mode.
    """
    diverging = linearise_at(likelihood, nominal, nominal.map_parameters_from(last_good.model, last_good.x), stop)
    for starts in score_candidate_starts(likelihood, diverging, self_excited, stop):
        index = starts[0].model.index("term", starts[0].candidate.key, starts[0].candidate.term.free_parameters[0].name)
        for start in {
            entry.x[index]: entry for entry in sorted(starts, key=lambda entry: entry.predicted_gain)
        }.values():
            if start.predicted_gain > MIN_PREDICTED_GAIN:
                yield start


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
        reached: longest window in which the starts are good fits, 0 for none.
        splits: largest number of inserted intermediate windows.
        rival: competing fit over the whole recording.
    """
    remaining, previous_chi2, rival_evidence = (
        list(stops)[::-1],
        1.0,
        np.inf if rival is None else rival.neg2_log_evidence,
    )
    fits: list[Fit] = []
    diverged_chi2: dict[float, float] = {}
    while running and remaining:
        stop = remaining[-1]
        max_iterations, tolerance = (14, 0.05) if stop == stops[-1] else (8, 1.0)
        fits = []
        for first in range(0, len(running), MAX_PARALLEL_FITS):
            best = min(
                (fit.neg2_log_evidence for fit in fits if satisfies_sign_constraints(fit)),
                default=rival_evidence - ABORT_MARGIN,
            )
            batch = running[first : first + MAX_PARALLEL_FITS]
            fits += fit_models(likelihood, batch, stop, max_iterations, tolerance, abort_above=best + ABORT_MARGIN)
        fits.sort(key=lambda fit: (not satisfies_sign_constraints(fit), fit.neg2_log_evidence))
        chi2 = reduced_chi2(fits[0])
        diverged = previous_chi2 < CHI2_LINEARISABLE and chi2 > DIVERGENCE_RATIO * max(previous_chi2, 1.0)
        if (
            diverged
            and splits
            and stop > MIN_WINDOW_RATIO * reached > 0.0
            and chi2 < MAX_RATIO_AFTER_SPLIT * diverged_chi2.get(stop, np.inf)
        ):
            remaining.append(float(np.sqrt(reached * stop)))
            diverged_chi2[stop] = chi2
            splits -= 1
            continue
        if fits[0].chi2 > rival_evidence or (
            stop >= stops[:WINDOWS_PER_STEP][-1] and _dominated(likelihood, fits[0], rival)
        ):
            return []
        reached, previous_chi2 = remaining.pop(), chi2
        if len(fits) <= BEAM_WIDTH or fits[BEAM_WIDTH].neg2_log_evidence > fits[0].neg2_log_evidence + PRUNE_MARGIN:
            running = _prune(list(_deduplicate(fits)), chi2 > CHI2_ADEQUATE, 4 * stop > stops[-1])
        # otherwise no candidate is distinguished yet, and all continue from their previous start
    # only the best fit of a candidate with several starts
    best_of = {fit.model.candidates[-1].key: fit for fit in reversed(fits) if satisfies_sign_constraints(fit)}
    return list(best_of.values())


def _deduplicate(fits: Sequence[Fit]) -> Iterator[Fit]:
    """Fits, sorted by quality, without those whose residual equals that of a better fit of the same candidate."""
    distinct: dict[str, list[Fit]] = {}
    for fit in fits:
        same_candidate = distinct.setdefault(fit.model.candidates[-1].key, [])
        if all(
            np.sum((fit.residual[fit.rows] - previous.residual[previous.rows]) ** 2) > DUPLICATE_DISTANCE_SIGMA2
            for previous in same_candidate
        ):
            same_candidate.append(fit)
            yield fit


def _dominated(likelihood: Likelihood, fit: Fit, rival: Fit | None) -> bool:
    """Whether a fit over a window is worse than ``rival`` even if it left only noise outside the window."""
    if rival is None:
        return False
    outside = likelihood.rows & ~fit.rows
    least_chi2 = min(float(np.sum(rival.residual[outside] ** 2)), MIN_NOISE_CHI2 * int(outside.sum()))
    return fit.chi2 + least_chi2 > rival.neg2_log_evidence + ABORT_MARGIN


def _prune(fits: list[Fit], unexplained: bool, few: bool) -> list[tuple[Model, Array]]:
    """Select the models that are continued over the next window, and their starts, by evidence.

    Args:
        unexplained: whether even the best fit is inadequate, so that the order is not reliable.
        few: whether to continue at most ``BEAM_WIDTH`` candidates.
    """
    best, worst = fits[0].neg2_log_evidence, max(fit.neg2_log_evidence for fit in fits)
    margin = max(PRUNE_MARGIN, 0.5 * (worst - best))
    # adequate fits are always continued: over a short window, refitted nominal values explain the same as any law
    remaining = [fit for fit in fits if fit.neg2_log_evidence < best + margin or reduced_chi2(fit) < CHI2_ADEQUATE]
    if unexplained:
        remaining = fits[: max(BEAM_WIDTH, len(remaining))]
    # The best fits with an impossible sign are continued with the opposite sign: a ringing mode fits with both.
    mirrored = [
        (fit.model, _flip_sign(fit))
        for fit in fits
        if not satisfies_sign_constraints(fit) and fit.neg2_log_evidence <= best
    ]
    remaining = [fit for fit in remaining if satisfies_sign_constraints(fit) or fit.neg2_log_evidence > best]
    return mirrored + [(fit.model, fit.x) for fit in (remaining[:BEAM_WIDTH] if few else remaining)]


def _flip_sign(fit: Fit) -> Array:
    """Parameters of a fit with the sign of the last term's amplitudes corrected and its hidden states negated."""
    key, x = fit.model.candidates[-1].key, fit.x.copy()
    for i, f in enumerate(fit.model.parameters):
        if f.owner == key and (f.kind == "hidden" or (f.parameter is not None and f.parameter.sign * x[i] < 0.0)):
            x[i] = -x[i]
    return x


def _init_from_last_good(score: ScoreTest, last_good: Fit) -> Array:
    """Start of a candidate: the nominal values of the last fitted window, and the term as in its score test."""
    x = score.model.map_parameters_from(last_good.model, last_good.x)
    of_candidate = [f.owner == score.candidate.key for f in score.model.parameters]
    x[of_candidate] = score.x[of_candidate]
    return x
