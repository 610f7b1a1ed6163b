"""Windows of increasing length: up to which a model has the phase right, and which follow."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from estimation.diagnosis.fit import Fit, Likelihood, fit_model
from estimation.diagnosis.model import Model

CHI2_LINEARISABLE = 2.0
"""Reduced chi-square up to which the phase error of a fit is small, so that the model is linear around it."""


CHI2_ADEQUATE = 1.08
"""Reduced chi-square up to which a model is adequate. On the fitted samples of a window, the candidate then explains
the misfit. On held-out samples, an additional discrepancy term would only correct details of the laws of named
terms."""

WINDOWS_PER_STEP = 5
"""Number of windows from the last one that the nominal model fits to the first that it does not. The effect of a
candidate may become visible in any of them."""

SPLIT_RATIO = 8.0
"""Ratio of the reduced chi-squares of the first failing window and of the last good one above which the failing window
is too long for a linearised model. A shorter one is then searched by bisection."""

MIN_WINDOW_RATIO = 1.03
"""Smallest ratio of the lengths of successive windows: 3 % more samples hardly change a fit."""


class DivergenceWindow(NamedTuple):
    """The windows between which the phase error of a model becomes too large.

    Attributes:
        last_good: its fit over the longest window ``reached`` in which its phase is right. If there is none,
            ``reached`` is 0 and this is the fit over the first window.
        failing: its fit over the window ``stop``, in which its phase error is too large, but still small.
    """

    last_good: Fit
    reached: float
    failing: Fit
    stop: float


def divergence_window(
    likelihood: Likelihood, model: Model, early: Sequence[Fit], stops: Sequence[float]
) -> DivergenceWindow:
    """The two windows between which ``model`` fails, found among ``stops`` and refined by bisection."""
    first = _first_divergent(early)
    last_good, reached, stop = early[max(first - 1, 0)], stops[first - 1] if first else 0.0, stops[first]
    failing = fit_model(likelihood, model, model.map_parameters_from(early[first].model, early[first].x), stop, 8)
    for later in stops[first + 1 :]:
        if reduced_chi2(failing) > CHI2_ADEQUATE:
            break
        # under the estimated noise the model may fit a window that it did not fit under the first estimate
        last_good, reached, stop = failing, stop, later
        failing = fit_model(likelihood, model, failing.x, stop, 8)
    while (
        reduced_chi2(failing) > SPLIT_RATIO * max(reduced_chi2(last_good), 1.0)
        and stop > MIN_WINDOW_RATIO**2 * reached > 0.0
    ):
        middle = float(np.sqrt(reached * stop))
        fit = fit_model(likelihood, model, model.map_parameters_from(last_good.model, last_good.x), middle, 8)
        if reduced_chi2(fit) < 2.0 * reduced_chi2(last_good):
            last_good, reached = fit, middle
        else:
            failing, stop = fit, middle
    return DivergenceWindow(last_good, reached, failing, stop)


def reduced_chi2(fit: Fit) -> float:
    """Reduced chi-square over the window of a fit."""
    return fit.chi2 / int(fit.rows.sum())


def _first_divergent(early: Sequence[Fit]) -> int:
    """Index of the first window over which the fit of the nominal model is clearly worse than before."""
    chi2 = [reduced_chi2(fit) for fit in early]
    first = 0
    while first + 1 < len(chi2) and chi2[first] < 2.0 * min([CHI2_LINEARISABLE, *chi2[:first]]):
        first += 1
    return first


def refine_windows(stops: Sequence[float]) -> Iterator[float]:
    """Windows after the first of ``stops``, with intermediate ones.

    Most are inserted before the first window that the nominal model does not fit, where an effect becomes visible.
    """
    for i, (low, high) in enumerate(pairwise(stops)):
        yield from np.geomspace(low, high, (WINDOWS_PER_STEP if i == 0 else 2) + 1)[1:-1].tolist()
        yield high
