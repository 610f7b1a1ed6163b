"""A fit that follows the motion where the nominal device loses its phase.

A discrepancy term of the mechanics is fitted over windows of increasing length. Around its fit the named laws are
linear, however large their effect: a law in the place of the discrepancy changes the motion only by the difference of
the two torques along it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from estimation.diagnosis.fit import Fit, Likelihood, fit_model
from estimation.diagnosis.model import Model
from estimation.diagnosis.parameters import Candidate
from scanner.arrays import Array

MAX_RESIDUAL_RATIO = 0.1
"""Residual without noise over signal, both as standard deviations, up to which a fit has the phase of the motion right:
an error of 0.1 rad, beside which the second order is a hundredth."""

MAX_RATIO_GROWTH = 2.0
"""Growth of that ratio from the first window on, up to which a larger one has another cause than the phase. A phase
error grows with the square of the length."""

MAX_WINDOW_GROWTH, MIN_WINDOW_GROWTH = 3.0, 1.03
"""Largest and smallest ratio of the lengths of successive windows."""

WINDOW_ITERATIONS = 8
"""Iterations of the fit over a window."""


def residual_ratio(likelihood: Likelihood, fit: Fit, stop: float = 1.0) -> float:
    """Largest ratio of residual, without the noise, to signal over a window, as standard deviations of a channel."""
    ratios = []
    for run, whiteners, signals in zip(
        fit.model.runs, likelihood.whiteners, fit.model.outputs(fit.x, stop), strict=True
    ):
        for output, whitener, signal in zip(run.outputs, whiteners, signals, strict=True):
            data = output.data[: signal.size]
            misfit = float(np.var(data - signal)) - whitener.noise_variance
            ratios.append(np.sqrt(max(misfit, 0.0) / max(float(np.var(data)), 1e-300)))
    return max(ratios)


def max_residual_ratio(likelihood: Likelihood, first: Fit, stop: float) -> float:
    """Largest residual ratio with which the phase is right, from the fit over the first window of length ``stop``."""
    return max(MAX_RESIDUAL_RATIO, MAX_RATIO_GROWTH * residual_ratio(likelihood, first, stop))


def fit_anchor(
    likelihood: Likelihood, nominal: Fit, early: Sequence[Fit], stops: Sequence[float], terms: Sequence[Candidate]
) -> Fit:
    """The nominal fit if it follows the motion, else with the first of ``terms`` that does, or the best of them.

    Args:
        nominal: over the whole recording.
        early: fits of the nominal device over the windows ``stops``.
        terms: discrepancy terms of the mechanics.
    """
    limit = max_residual_ratio(likelihood, early[0], stops[0])
    fits = [nominal]
    for term in terms:
        if residual_ratio(likelihood, fits[-1]) < limit:
            return fits[-1]
        reached = 0
        while reached + 1 < len(early) and residual_ratio(likelihood, early[reached + 1], stops[reached + 1]) < limit:
            reached += 1
        model = Model(nominal.model.runs, nominal.model.device, [*nominal.model.candidates, term], nominal.model.mains)
        start = model.map_parameters_from(early[reached].model, early[reached].x)
        fits.append(fit_growing(likelihood, model, start, stops[reached], limit))
    return min(fits, key=lambda fit: fit.chi2)


def fit_growing(
    likelihood: Likelihood, model: Model, x: Array, reached: float, limit: float = MAX_RESIDUAL_RATIO
) -> Fit:
    """Fit over windows that grow as fast as the motion is followed, from one of the length ``reached`` on.

    Args:
        x: start, shape (p,).
        limit: largest residual ratio with which the motion is followed.
    """
    growth, stop = MAX_WINDOW_GROWTH, reached
    while True:
        fit = fit_model(likelihood, model, x, stop, WINDOW_ITERATIONS, tolerance=1.0)
        if stop > reached and residual_ratio(likelihood, fit, stop) > limit and growth > MIN_WINDOW_GROWTH:
            growth = np.sqrt(growth)
        elif stop >= 1.0:
            return fit
        else:
            reached, x = stop, fit.x
            growth = min(growth * growth, MAX_WINDOW_GROWTH)
        stop = min(1.0, reached * growth)
