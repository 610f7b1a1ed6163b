"""A fit that follows the motion where the nominal device loses its phase.

Terms of the mechanics are fitted over windows of increasing length: a frequency and a damping that depend on the
amplitude, to which every weak nonlinearity of a free oscillation averages, else a discrepancy term. Around their fit
the named laws are linear, however large their effect: a law in their place changes the motion only by the difference of
the two torques along it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from estimation.device_fit.fit import TIME_BLOCKS, Fit, Likelihood, fit_model, held_out_samples
from estimation.device_fit.initial import window_schedule
from estimation.device_fit.model import Model
from estimation.device_fit.parameters import Candidate
from scanner.arrays import Array

MAX_RESIDUAL_RATIO = 0.1
"""Residual without noise over signal, both as standard deviations, up to which a fit has the phase of the motion right:
an error of 0.1 rad, beside which the second order is a hundredth."""

MAX_RATIO_GROWTH = 2.0
"""Growth of that ratio from the first window on, up to which a larger one has another cause than the phase. A phase
error grows with the square of the length."""

MAX_WINDOW_GROWTH, MIN_WINDOW_GROWTH = 3.0, 1.1
"""Largest and smallest ratio of the lengths of successive windows."""

MAX_CORRECTABLE_RATIO = 0.5
"""That ratio up to which a fit over a longer window corrects the phase: an error of half a radian, from which
Gauss-Newton steps converge."""

MAX_SIGNAL = 1e100
"""Signal from which a trajectory has diverged: its square would overflow."""

WINDOW_ITERATIONS, WINDOW_TOLERANCE = 8, 1.0
"""Iterations of the fit over a window, and the fall of the misfit by a step below which it ends."""


def residual_ratio(likelihood: Likelihood, fit: Fit, stop: float = 1.0) -> float:
    """Largest ratio of residual, without the noise, to signal in a window, as standard deviations.

    It is taken over parts of the window, each as long as the first window of a fit: late in a decay the phase may be
    lost although the residual is small. A diverging trajectory has an infinite ratio.
    """
    return float(_residual_ratios(likelihood, fit, stop).max())


def _residual_ratios(likelihood: Likelihood, fit: Fit, stop: float, fitted: bool = False) -> Array:
    """The ratio in each part of a window, shape (parts,), in the channel where it is largest.

    Args:
        fitted: leave out the samples that no fit uses; a part with no others has the ratio 0.
    """
    parts = int(np.clip(round(stop / window_schedule(fit.model)[0]), 1, TIME_BLOCKS))
    largest = np.zeros(parts)
    for run, whiteners, signals in zip(
        fit.model.runs, likelihood.whiteners, fit.model.outputs(fit.x, stop), strict=True
    ):
        for output, whitener, signal in zip(run.outputs, whiteners, signals, strict=True):
            data, noise = output.data[: signal.size], whitener.noise_variance
            used = ~held_out_samples(output.data.size)[: signal.size] if fitted else np.ones(signal.size, bool)
            used[: output.guard[0]] = False
            for i, part in enumerate(np.array_split(np.arange(signal.size), parts)):
                rows = part[used[part]]
                if rows.size == 0:
                    continue
                if not np.all(np.abs(signal[rows]) < MAX_SIGNAL):
                    largest[i] = np.inf
                elif (motion := float(np.var(data[rows])) - noise) > noise:
                    misfit = max(float(np.var(data[rows] - signal[rows])) - noise, 0.0)
                    largest[i] = max(largest[i], np.sqrt(misfit / motion))
    return largest


def max_residual_ratio(likelihood: Likelihood, first: Fit, stop: float) -> float:
    """Largest residual ratio with which the phase is right, from the fit over the first window of length ``stop``."""
    return max(MAX_RESIDUAL_RATIO, MAX_RATIO_GROWTH * residual_ratio(likelihood, first, stop))


def follow_motion(likelihood: Likelihood, early: Sequence[Fit], stops: Sequence[float]) -> Fit:
    """The last of the fits over growing windows, or one over windows in between where only that follows the motion.

    An oscillation that grows when a swept drive reaches a resonance is not predicted by the window before. Where
    windows in between do not follow the motion to its end either, an effect is missing, and the last fit stays.

    Args:
        early: fits of the nominal device over the windows ``stops``, the last one over the whole recording.
    """
    if residual_ratio(likelihood, early[-1]) < MAX_CORRECTABLE_RATIO:
        return early[-1]
    reached = _last_that_follows(likelihood, early, stops, MAX_CORRECTABLE_RATIO)
    grown = fit_growing(likelihood, early[-1].model, early[reached].x, stops[reached])
    return grown if residual_ratio(likelihood, grown) < MAX_CORRECTABLE_RATIO else early[-1]


def _last_that_follows(likelihood: Likelihood, early: Sequence[Fit], stops: Sequence[float], limit: float) -> int:
    """Index of the last fit up to which all after the first have a residual ratio below a limit in their window."""
    reached = 0
    while reached + 1 < len(early) and residual_ratio(likelihood, early[reached + 1], stops[reached + 1]) < limit:
        reached += 1
    return reached


def fit_anchor(
    likelihood: Likelihood,
    nominal: Fit,
    early: Sequence[Fit],
    stops: Sequence[float],
    groups: Sequence[Sequence[Candidate]],
) -> tuple[Fit, list[Fit]]:
    """The nominal fit if it follows the motion, else that with the first of ``groups`` that does; nominal if none does.

    A misfit that none of them changes has another cause than the phase.

    Args:
        nominal: over the whole recording.
        early: fits of the nominal device over the windows ``stops``.
        groups: of terms of the mechanics.

    Returns:
        The fit, and all fits with groups that were made.
    """
    limit = max_residual_ratio(likelihood, early[0], stops[0])
    if residual_ratio(likelihood, nominal) < limit:
        return nominal, []
    fits, reached = list[Fit](), _last_that_follows(likelihood, early, stops, limit)
    for terms in groups:
        model = nominal.model.with_candidates([*nominal.model.candidates, *terms])
        start = model.map_parameters_from(early[reached].model, early[reached].x)
        fits.append(fit_growing(likelihood, model, start, stops[reached], max(limit, MAX_CORRECTABLE_RATIO)))
        if residual_ratio(likelihood, fits[-1]) < limit:
            return fits[-1], fits
    return nominal, fits


def fit_growing(
    likelihood: Likelihood,
    model: Model,
    x: Array,
    reached: float,
    limit: float = MAX_CORRECTABLE_RATIO,
    fixed: Sequence[int] = (),
    abort_above: float = np.inf,
) -> Fit:
    """Fit over windows that grow as fast as the motion is followed, from one of the length ``reached`` on.

    Each window is as long as the fit over the one before predicts the motion. Where even the fit over such a window
    loses it in samples that it uses, another effect is missing, and the whole recording is fitted from there.

    Args:
        x: start, shape (p,).
        limit: residual ratio up to which a fit over a longer window corrects the phase.
        fixed: indices of parameters that keep their value.
        abort_above: chi-square of the whole recording above which the fit is of no use. That of a window is smaller,
            so it ends at the first one above, with the fit over that window.
    """
    stop = reached
    while True:
        fit = fit_window(likelihood, model, x, stop, fixed)
        if stop >= 1.0 or fit.chi2 > abort_above:
            return fit
        lost = stop > reached and _residual_ratios(likelihood, fit, stop, fitted=True).max() > limit
        x, stop = fit.x, 1.0 if lost else _next_window(likelihood, fit, stop, limit)


def fit_window(likelihood: Likelihood, model: Model, x: Array, stop: float, fixed: Sequence[int] = ()) -> Fit:
    """The fit over one window, which a fit over a longer one continues."""
    return fit_model(likelihood, model, x, stop, WINDOW_ITERATIONS, tolerance=WINDOW_TOLERANCE, fixed=fixed)


def _next_window(likelihood: Likelihood, fit: Fit, stop: float, limit: float) -> float:
    """End of the window after that of ``fit`` over ``stop``: with the first part in which that fit loses the motion."""
    longest = min(1.0, MAX_WINDOW_GROWTH * stop)
    lost = _residual_ratios(likelihood, fit, longest) > limit
    predicted = longest * (np.argmax(lost) + 1) / lost.size if lost.any() else longest
    return float(min(longest, max(predicted, MIN_WINDOW_GROWTH * stop)))
