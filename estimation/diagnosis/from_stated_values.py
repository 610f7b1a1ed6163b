"""Fits that begin at the stated values, where nominal values have absorbed a misfit."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial

import numpy as np

from estimation.candidate_terms.anchor import WINDOW_TOLERANCE, fit_growing, fit_window
from estimation.candidate_terms.screening import ScoreTest, is_linear, score_candidate_starts
from estimation.candidate_terms.significance import DETECTION_THRESHOLD, MAX_HELD_OUT_CHI2, residual_is_noise
from estimation.device_fit.fit import (
    Fit,
    Likelihood,
    fit_model,
    misfit,
    nominal_values_are_improbable,
    stated_values,
)
from estimation.device_fit.model import Model
from estimation.device_fit.parameters import Candidate
from estimation.parallel import map_fits
from scanner.arrays import Array
from scanner.terms.term import AMPLITUDE_KINDS

MAX_WINDOW_STARTS = 2
"""Starts of a law that is linear in no amplitude that are fitted over a window around each of two fits, for either sign
of its size. In two scans with a mode that grows, one of the first two led to the right fit."""

MAX_CONTINUED_FITS = 3
"""Fits over a window, in different minima, that are continued: a mode of either sign explains the first periods."""


def fit_from_stated_values(likelihood: Likelihood, nominal: Fit, terms: Sequence[Candidate], first: float) -> Fit:
    """The fit of the device with terms over growing windows, from the stated values.

    Short windows of a precise signal hardly limit some combinations of the nominal values, and the way back leads
    through a long curved valley. If the values end improbably far from the stated ones, they keep those until the
    whole recording is followed.

    Args:
        first: end of the first window, as a fraction of the recordings.
    """
    model = nominal.model.with_candidates([*nominal.model.candidates, *terms])
    start = stated_values(model, model.map_parameters_from(nominal.model, nominal.x))
    fit = fit_growing(likelihood, model, start, first)
    if nominal_values_are_improbable(fit):
        fit = fit_model(likelihood, model, fit_with_stated_values(likelihood, model, start, first).x)
    return fit


def fit_with_stated_values(likelihood: Likelihood, model: Model, x: Array, first: float) -> Fit:
    """The fit over growing windows from ``x`` with the nominal values kept as stated."""
    return fit_growing(likelihood, model, stated_values(model, x), first, fixed=model.indices("nominal"))


def fit_in_another_minimum(likelihood: Likelihood, nominal: Fit, drifting: Sequence[Fit]) -> Fit | None:
    """The nominal device in a minimum in which it leaves only noise, reached from fits with drifts; None if none is.

    With the device file of another scanner, fits of its first window from the stated values end in a wrong minimum.

    Args:
        nominal: the fit of the nominal device; if it leaves only noise, no other minimum is sought.
        drifting: fits with drifts from the stated values.
    """
    if residual_is_noise(nominal):
        return None

    def without_drifts(fit: Fit) -> Fit:
        return fit_model(likelihood, nominal.model, nominal.model.map_parameters_from(fit.model, fit.x))

    fits = filter(residual_is_noise, map_fits(without_drifts, drifting, likelihood.steps))
    return min(fits, key=misfit, default=None)


def fit_nonlinear_law(
    likelihood: Likelihood, nominal: Fit, pool: Sequence[Candidate], stops: Sequence[float]
) -> Fit | None:
    """The device with a law that is linear in no amplitude, as a mode that grows, if it leaves only noise; else None.

    Over the whole recording its misfit has several minima, and nominal values have absorbed a part of the effect.
    Early, the stated values are nearly right. There starts of the law are compared, the nominal values are fitted after
    it, and fits that leave only noise are continued over growing windows.

    Args:
        stops: ends of growing windows as fractions of the recordings. The longest in which such a fit is found is used.
    """
    model, stated = nominal.model, stated_values(nominal.model, nominal.x)
    for stop in reversed(stops[:-1]):
        kept = fit_window(likelihood, model, stated, stop, fixed=model.indices("nominal"))
        free = fit_window(likelihood, model, kept.x, stop)
        if _leaves_noise(free):
            continue
        scored = [nonlinear_starts(likelihood, fit, pool, stop) for fit in (kept, free)]
        starts = [start for each in scored for start in _best_of_each_sign(each)]
        fits = map_fits(partial(_fit_law_first, likelihood, stop), starts, stop * likelihood.steps)
        different = _different(filter(_leaves_noise, fits))[:MAX_CONTINUED_FITS]
        grown = map_fits(partial(_continue_fit, likelihood, stop), different, likelihood.steps)
        possible = [fit for fit in grown if residual_is_noise(fit) and not nominal_values_are_improbable(fit)]
        if possible:
            return min(possible, key=lambda fit: fit.neg2_log_evidence)
    return None


def nonlinear_starts(
    likelihood: Likelihood, base: Fit, pool: Sequence[Candidate], stop: float = 1.0
) -> list[ScoreTest]:
    """Starts of laws that are linear in no amplitude beside those of a fit, the largest predicted gain first.

    Args:
        stop: end of the window of ``base`` as a fraction of the recordings.
    """
    present = {candidate.key for candidate in base.model.candidates}
    others = [candidate for candidate in pool if not is_linear(candidate) and candidate.key not in present]
    scores = [score for starts in score_candidate_starts(likelihood, base, others, stop) for score in starts]
    promising = [score for score in scores if score.predicted_gain > DETECTION_THRESHOLD]
    return sorted(promising, key=lambda score: -score.predicted_gain)


def _best_of_each_sign(starts: Sequence[ScoreTest]) -> list[ScoreTest]:
    """The first starts with each sign of the law's signed parameters."""
    by_sign: dict[tuple[float, ...], list[ScoreTest]] = {}
    for start in starts:
        of_term = zip(
            start.model.indices("term", start.candidate.key), start.candidate.term.free_parameters, strict=True
        )
        signed = [i for i, parameter in of_term if parameter.kind in AMPLITUDE_KINDS]
        by_sign.setdefault(tuple(np.sign(start.x[signed])), []).append(start)
    return [start for of_sign in by_sign.values() for start in of_sign[:MAX_WINDOW_STARTS]]


def _fit_law_first(likelihood: Likelihood, stop: float, start: ScoreTest) -> Fit:
    """The fit over a window of a law beside the stated values, then of all."""
    model = start.model
    law = fit_window(likelihood, model, stated_values(model, start.x), stop, fixed=model.indices("nominal"))
    return fit_window(likelihood, model, law.x, stop)


def _continue_fit(likelihood: Likelihood, stop: float, fit: Fit) -> Fit:
    """The fit of the whole recording from one over a window."""
    return fit_model(likelihood, fit.model, fit_growing(likelihood, fit.model, fit.x, stop).x)


def _leaves_noise(fit: Fit) -> bool:
    """Whether a fit leaves only noise in the samples of its window."""
    return fit.chi2 < MAX_HELD_OUT_CHI2 * int(np.count_nonzero(fit.rows))


def _different(fits: Iterable[Fit]) -> list[Fit]:
    """Fits that ended in different minima, the best first."""
    ranked = sorted(fits, key=misfit)
    return [fit for i, fit in enumerate(ranked) if i == 0 or misfit(fit) - misfit(ranked[i - 1]) > WINDOW_TOLERANCE]
