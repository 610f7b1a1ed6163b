"""Initial values of a fit: angle and rate at the first sample, and windows of increasing length."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from estimation.device_fit.data import Output
from estimation.device_fit.fit import INITIAL_STEP, MISFIT_TOLERANCE, Fit, Likelihood, fit_model, fit_models, misfit
from estimation.device_fit.model import Model
from estimation.device_fit.noise import Whitener, flat_psd, make_whitener, near_lines, noise_psd
from scanner.arrays import Array
from scanner.errors import BadInput

FIRST_WINDOW_PERIODS = 5
"""Periods of the motion in the first window: so few that an error of the nominal frequency within its tolerance changes
the phase by less than half a cycle."""

MIN_WINDOW_PERIODS = 4
"""Periods of the motion in the first window that are compared, where the readout settles for longer than one."""

WINDOW_GROWTH = 3.0
"""Ratio of the lengths of successive windows. A frequency that was fitted over one window predicts the phase over three
times its length with an error far below half a cycle."""

WINDOW_ITERATIONS, WINDOW_TOLERANCE = 6, 1.0
"""Largest number of iterations over a window, and the fall of the misfit by a step below which its fit ends: the next
window continues the fit. The last has twice as many iterations, and ends as other fits do."""

START_AMPLITUDES = np.geomspace(0.03, 1.5, 9)
"""Amplitudes of the motion at the first sample that are tried, in its natural amplitude."""

START_PHASES_RAD = 2 * np.pi * np.arange(12) / 12
"""Phases of the motion at the first sample that are tried."""

FITTED_STARTS = 3
"""Starts of lowest misfit from which the initial state is fitted."""

EXCLUDED_HARMONICS = 12
"""Harmonics of the motion around which no noise is measured, because a misfit concentrates there."""


def window_schedule(model: Model) -> list[float]:
    """Growing windows as fractions of the recordings, the last one 1.

    Far below its resonance an axis follows its drive, so its phase cannot be lost and one window suffices.
    """
    if all(scales.rate < 0.5 * np.sqrt(scales.k / scales.J) for run in model.runs for scales in run.scales.values()):
        return [1.0]
    periods = min(run.duration * scales.rate / (2 * np.pi) for run in model.runs for scales in run.scales.values())
    left_out = max(output.guard[0] / output.data.size for run in model.runs for output in run.outputs)
    stops = [max(FIRST_WINDOW_PERIODS / periods, left_out + MIN_WINDOW_PERIODS / periods)]
    while stops[-1] * WINDOW_GROWTH < 0.7:
        stops.append(stops[-1] * WINDOW_GROWTH)
    return [*stops, 1.0] if stops[0] < 0.7 else [1.0]


def flat_whiteners(model: Model) -> list[list[Whitener]]:
    """Whiteners for white noise with the level of each channel at high frequencies."""
    return [[_flat_whitener(output) for output in run.outputs] for run in model.runs]


def _flat_whitener(output: Output) -> Whitener:
    return make_whitener(flat_psd(output.data, output.bins), output.data.size, output.guard)


def stated_whitener(output: Output) -> Whitener:
    """Whitener for the stated noise, or for that of the channel at high frequencies where none is stated.

    Raises:
        BadInput: the stated noise is zero.
    """
    if output.noise_sd is None:
        return _flat_whitener(output)
    if output.noise_sd <= 0.0:
        hint = "state noise_var or noise_sd of the readout"
        raise BadInput("its readout states no noise: every effect would show", channel=output.name, hint=hint)
    thinning = output.step * output.full_rate
    power = output.data.size * output.noise_sd**2 / thinning
    return make_whitener(np.full(output.bins, power), output.data.size, output.guard)


def estimate_whiteners(model: Model, x: Array) -> list[list[Whitener]]:
    """Whiteners for the noise in the residual of a model at ``x``, estimated off the harmonics of motion and drive."""
    whiteners = []
    for run, signals in zip(model.runs, model.outputs(x), strict=True):
        row = []
        for output, signal in zip(run.outputs, signals, strict=True):
            motions = [run.scales[axis].rate / (2 * np.pi) for axis in output.axes]
            harmonics = np.outer(motions, np.arange(1, EXCLUDED_HARMONICS + 1)).ravel()
            lines = np.concatenate([harmonics, *(run.lines[axis] for axis in output.axes)])
            width = 0.06 * max(motions)  # the width of the lines of a decaying motion
            if _lines_overlap(output, lines, width, min(motions)):
                width = 0.0
            share = output.noisy_share if model.clips and output.kind == "sense" else None
            psd, first = noise_psd(output.data - signal, output.bins, output.step, lines, width, share)
            row.append(make_whitener(psd, output.data.size, output.guard, first, share))
        whiteners.append(row)
    return whiteners


def refit_under_own_noise(fit: Fit) -> tuple[Likelihood, Fit]:
    """The likelihood under the noise that a fit leaves, and the fit continued under it."""
    likelihood = Likelihood(fit.model.runs, estimate_whiteners(fit.model, fit.x))
    return likelihood, fit_model(likelihood, fit.model, fit.x)


def _lines_overlap(output: Output, lines: Array, width: float, motion: float) -> bool:
    """Whether lines, as those of a multisine, exclude more than 80 % of the bins around the motion."""
    frequency = np.arange(output.bins) / (output.data.size * output.step)
    around = frequency < 1.5 * motion
    return bool(near_lines(frequency, lines, width)[around].mean() > 0.8)


def fit_initial_state(likelihood: Likelihood, model: Model, stop: float) -> Fit:
    """Fit the initial angle and rate over the first window, from a grid of amplitudes and phases for each run.

    An even capacitance determines the phase modulo pi only: the sign of the motion is not identifiable from the
    recording, and the first of two equivalent starts is used.

    Args:
        stop: end of the window as a fraction of the recordings.
    """
    x = np.zeros(len(model.parameters))
    states: list[list[Array]] = []
    for r, run in enumerate(model.runs):
        for axis in run.inputs:
            indices = start_indices(model, axis, r)
            misfits = []
            for amplitude in START_AMPLITUDES:
                for phase in START_PHASES_RAD:
                    x[indices] = amplitude * np.cos(phase), amplitude * np.sin(phase)
                    misfits.append((_relative_misfit(model, r, x, stop), x[indices].copy()))
            misfits.sort(key=lambda pair: pair[0])
            x[indices] = misfits[0][1]
            states.append([values for _, values in misfits[:FITTED_STARTS]])
    starts_x = [x.copy() for _ in range(FITTED_STARTS)]
    for i, x_start in enumerate(starts_x):
        best_states = iter(states)
        for r, run in enumerate(model.runs):
            for axis in run.inputs:
                x_start[start_indices(model, axis, r)] = next(best_states)[i]
    fits = fit_models(likelihood, [(model, x_start) for x_start in starts_x], stop, max_iterations=10)
    return min(fits, key=misfit)


def start_indices(model: Model, axis: str, r: int) -> list[int]:
    """Indices in x of the initial angle and rate of an axis in run ``r``."""
    return [i for i, f in enumerate(model.parameters) if (f.kind, f.owner, f.run) == ("start", axis, r)]


def _relative_misfit(model: Model, r: int, x: Array, stop: float) -> float:
    """Sum over the channels of run ``r`` of the residual's variance relative to that of the channel."""
    total = 0.0
    for output, signal in zip(model.runs[r].outputs, model.outputs(x, stop)[r], strict=True):
        data = output.data[: signal.size]
        total += float(np.mean((data - signal)[output.guard[0] :] ** 2)) / max(float(output.data.var()), 1e-300)
    return total


def fit_progressively(likelihood: Likelihood, model: Model, stops: Sequence[float]) -> list[Fit]:
    """Fits from the initial state over windows of increasing length, each started at the result of the previous one.

    Args:
        stops: ends of the windows as fractions of the recordings; see :func:`window_schedule`.
    """
    x = fit_initial_state(likelihood, model, stops[0]).x
    steps = np.full(x.size, INITIAL_STEP)
    fits: list[Fit] = []
    for stop in stops:
        last = stop == stops[-1]
        iterations = 2 * WINDOW_ITERATIONS if last else WINDOW_ITERATIONS
        fits.append(
            fit_model(likelihood, model, x, stop, iterations, steps, MISFIT_TOLERANCE if last else WINDOW_TOLERANCE)
        )
        x = fits[-1].x
    return fits
