"""Output-error fit of a model to the recorded channels, with Gaussian priors.

Trajectories are fitted, not derivatives. The initial state of every recording is a parameter, and every residual is
whitened by the noise that was estimated before. A fifth of the samples is held out for validation.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimation.device_fit.data import Run
from estimation.device_fit.deviations import MIN_PULL_PROBABILITY, deviations_are_improbable
from estimation.device_fit.model import Model
from estimation.device_fit.noise import Whitener, sample_times
from estimation.least_squares import fit_levenberg_marquardt, laplace_neg2_log_evidence
from estimation.parallel import map_fits, map_parallel
from scanner.arrays import Array, Mask

TIME_BLOCKS = 20
"""Blocks of equal duration into which a recording is divided for validation: short against a drift, long against a
period of the motion."""

VALIDATION_BLOCK_INTERVAL = 5
"""Every fifth block is held out of every fit: a fifth of the data, spread over the recording."""

COMPARED_WINDOW_SHARE = 0.98
"""Share of a window whose samples are fitted: the whitening of the others depends on samples beyond the window."""

DIVERGED_RESIDUAL, MAX_RESIDUAL = 1e6, 1e100
"""Residuals of a diverging trajectory above the second number, whose square would overflow, are replaced by the
first."""

MISFIT_TOLERANCE = 0.05
"""Fall of the misfit by a step below which a fit ends: about a hundredth of the difference in -2 log evidence
between laws that are distinguished."""

INITIAL_STEP = 1e-4
"""First difference step of every parameter, in prior standard deviations."""

STEP_CHANGE_SIGMA = 0.3
"""Norm of the change of the residual [sigma] that a difference step should cause: far above the rounding error, and
small enough for the residual to change linearly."""

MIN_STEP, MAX_STEP, STEP_WITHOUT_EFFECT = 1e-7, 3e-2, 1e-2
"""Bounds of a difference step, and the step of a parameter without effect, in prior standard deviations. Below the
first, rounding dominates; above the second, the change is no longer linear."""


@dataclass(frozen=True)
class Fit:
    """A fitted model.

    Attributes:
        model: the fitted model.
        x: parameters at the best fit, shape (p,), in prior standard deviations.
        chi2: sum of squares of the fitted residuals.
        penalty: sum of squares of x, weighted with the prior precisions.
        residual: whitened, all samples of all channels, shape (N,).
        jacobian: of the whitened residual, shape (N, p).
        rows: mask of the fitted samples, shape (N,).
        validation_rows: mask of the held-out samples, shape (N,).
        validation_noise: chi-square of the held-out samples that noise alone has: their number, less where a clipped
            signal has no noise.
        neg2_log_evidence: by Laplace's method; lower is better.
    """

    model: Model
    x: Array
    chi2: float
    penalty: float
    residual: Array
    jacobian: Array
    rows: Mask
    validation_rows: Mask
    validation_noise: float
    neg2_log_evidence: float

    @property
    def covariance(self) -> Array:
        """Posterior covariance of x, shape (p, p)."""
        fitted = self.jacobian[self.rows]
        return np.asarray(np.linalg.inv(fitted.T @ fitted + np.diag(self.model.precision)))

    @property
    def validation_chi2(self) -> float:
        """Reduced chi-square of the held-out samples."""
        return float(np.sum(self.residual[self.validation_rows] ** 2)) / self.validation_noise


def misfit(fit: Fit) -> float:
    """What a fit minimises: chi-square and the priors' penalty."""
    return fit.chi2 + fit.penalty


def nominal_values_are_improbable(fit: Fit, probability: float = MIN_PULL_PROBABILITY) -> bool:
    """Whether the nominal values lie so far from the stated ones, in tolerances, that they have absorbed a misfit."""
    return deviations_are_improbable(fit.x[fit.model.indices("nominal")], probability)


def stated_values(model: Model, x: Array) -> Array:
    """Parameters with the nominal values as stated, shape (p,)."""
    return np.where([f.kind == "nominal" for f in model.parameters], 0.0, x)


def time_blocks(time: Array) -> NDArray[np.intp]:
    """Number of the block in which each of ``time``, as a fraction of the recording, lies."""
    return np.floor(time * TIME_BLOCKS).astype(np.intp)


def _is_held_out(time: Array) -> Mask:
    """Whether ``time``, as a fraction of the recording, lies in a block that is held out."""
    return np.asarray(time_blocks(time) % VALIDATION_BLOCK_INTERVAL == VALIDATION_BLOCK_INTERVAL // 2)


def held_out_samples(size: int, guard: tuple[int, int] = (0, 0)) -> Mask:
    """Samples of a channel that no fit uses, shape (size,): every fifth block, without the guards at its ends."""
    rows = _is_held_out(sample_times(size))
    rows[: guard[0]] = False
    rows[size - guard[1] :] = False
    return rows


class Likelihood:
    """Gaussian likelihood of the recordings: whitened residuals of a model, and masks of fitted and held-out samples.

    Attributes:
        runs: the recordings.
        steps: integration steps of all axes and recordings.
        whiteners: of each recording, one per channel in order.
        rows, validation_rows: masks over all whitened samples, shape (N,).
        time: of every whitened sample as a fraction of its recording, shape (N,).
        channel: index of its channel, counted over all recordings, shape (N,).
        validation_noise: chi-square of the held-out samples that noise alone has.
    """

    def __init__(self, runs: Sequence[Run], whiteners: Sequence[Sequence[Whitener]]):
        self.runs, self.whiteners = tuple(runs), tuple(tuple(row) for row in whiteners)
        self.steps = sum(run.steps for run in runs)
        flat = [whitener for row in self.whiteners for whitener in row]
        self.time = np.concatenate([whitener.time for whitener in flat])
        self.channel = np.concatenate([np.full(whitener.samples, i) for i, whitener in enumerate(flat)])
        compared = np.concatenate([whitener.keep for whitener in flat])
        validation = _is_held_out(self.time)
        self.rows, self.validation_rows = compared & ~validation, compared & validation
        noisy_share = np.concatenate([whitener.noisy_share for whitener in flat])
        self.validation_noise = max(float(noisy_share[self.validation_rows].sum()), 1.0)
        self._whitened: dict[tuple[object, ...], Array] = {}

    def fitted(self, stop: float) -> Mask:
        """Mask of the samples that are fitted over a window, the fraction ``stop`` of the recordings."""
        return self.rows & (self.time < COMPARED_WINDOW_SHARE * stop) if stop < 1.0 else self.rows

    def residual(self, model: Model, x: Array, stop: float = 1.0) -> Array:
        """Whitened data minus model, shape (N,); zero beyond the window ``stop``.

        A diverging trajectory gives huge but finite residuals, so that a fit rejects the step to it.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            return self._residual(model, x, stop)

    def _residual(self, model: Model, x: Array, stop: float) -> Array:
        parts = []
        for run, whiteners, signals in zip(self.runs, self.whiteners, model.outputs(x, stop), strict=True):
            for output, whitener, signal in zip(run.outputs, whiteners, signals, strict=True):
                difference = np.zeros(output.data.size)
                difference[: signal.size] = output.data[: signal.size] - signal
                parts.append(whitener(difference))
        residual = np.concatenate(parts)
        residual[~(np.abs(residual) < MAX_RESIDUAL)] = DIVERGED_RESIDUAL
        return residual

    def _additive_columns(self, model: Model, stop: float) -> dict[int, Array]:
        """Jacobian columns, by index in x, of the parameters that only add to a channel; they do not depend on x."""
        columns: dict[int, Array] = {}
        first = 0
        for r, (run, whiteners) in enumerate(zip(self.runs, self.whiteners, strict=True)):
            for output, whitener in zip(run.outputs, whiteners, strict=True):
                for i, values in zip(*model.basis[(r, output.name)], strict=True):
                    key = (r, output.name, model.parameters[i].name, model.mains, stop)
                    if key not in self._whitened:
                        difference = -values.copy()
                        difference[int(stop * values.size) if stop < 1.0 else values.size :] = 0.0
                        self._whitened[key] = whitener(difference)
                    columns[i] = np.zeros(self.time.size)
                    columns[i][first : first + whitener.samples] = self._whitened[key]
                first += whitener.samples
        return columns

    def jacobian(self, model: Model, x: Array, residual: Array, steps: Array, stop: float = 1.0) -> Array:
        """Derivatives of the residual by one-sided differences, shape (N, p).

        Args:
            residual: at ``x``, shape (N,).
            steps: difference steps, shape (p,); adapted in place so that each changes the residual by
                ``STEP_CHANGE_SIGMA``.
        """
        columns = np.empty((x.size, residual.size)).T  # in memory column by column, as they are filled
        additive = self._additive_columns(model, stop)
        for i, column in additive.items():
            columns[:, i] = column

        trials = {}
        for i in set(range(x.size)) - set(additive):
            trials[i] = x.copy()
            trials[i][i] += steps[i]
        model.prefetch_trajectories(list(trials.values()), stop, parallel=True)

        def fill(i: int) -> None:
            columns[:, i] = (self.residual(model, trials[i], stop) - residual) / steps[i]
            norm = np.linalg.norm(columns[:, i])
            steps[i] = np.clip(STEP_CHANGE_SIGMA / norm if norm else STEP_WITHOUT_EFFECT, MIN_STEP, MAX_STEP)

        map_parallel(fill, trials, model.steps)
        return columns


def fit_model(
    likelihood: Likelihood,
    model: Model,
    x: Array,
    stop: float = 1.0,
    max_iterations: int = 12,
    steps: Array | None = None,
    tolerance: float = MISFIT_TOLERANCE,
    abort_above: float = np.inf,
    fixed: Sequence[int] = (),
) -> Fit:
    """Fit a model to the samples of a window; see ``estimation.least_squares.fit_levenberg_marquardt``.

    Args:
        x: start, shape (p,).
        stop: end of the window as a fraction of the recordings.
        max_iterations: largest number of new Jacobians.
        steps: difference steps, shape (p,), adapted in place.
        tolerance: stop when a step lowers the misfit by less.
        abort_above: misfit of a competing fit. A fit above it that no longer approaches it is aborted.
        fixed: indices of parameters that keep their value.
    """
    steps = np.full(x.size, INITIAL_STEP) if steps is None else steps
    rows = likelihood.fitted(stop)

    def residual(trial: Array) -> Array:
        model.prefetch_trajectories([trial], stop, parallel=True)
        return likelihood.residual(model, trial, stop)

    result = fit_levenberg_marquardt(
        residual,
        lambda trial, residual: likelihood.jacobian(model, trial, residual, steps, stop),
        x,
        model.precision,
        rows=rows,
        fixed=fixed,
        max_iterations=max_iterations,
        tolerance=tolerance,
        abort_above=abort_above,
    )
    return _finalise_fit(likelihood, model, result.x, result.residual, result.jacobian, rows)


def fit_models(
    likelihood: Likelihood,
    starts: Iterable[tuple[Model, Array]],
    stop: float = 1.0,
    max_iterations: int = 12,
    abort_above: float = np.inf,
) -> list[Fit]:
    """:func:`fit_model` for each model and start, ``MAX_PARALLEL_FITS`` at a time, in the order of ``starts``."""

    def fit(start: tuple[Model, Array]) -> Fit:
        return fit_model(likelihood, *start, stop, max_iterations, abort_above=abort_above)

    return map_fits(fit, starts, likelihood.steps)


def linearise_at(likelihood: Likelihood, model: Model, x: Array) -> Fit:
    """Residual and Jacobian of a model at ``x``, as a fit without iterations."""
    residual, steps = likelihood.residual(model, x), np.full(x.size, INITIAL_STEP)
    for _ in range(2):  # the first Jacobian adapts the steps
        jacobian = likelihood.jacobian(model, x, residual, steps)
    return _finalise_fit(likelihood, model, x, residual, jacobian, likelihood.rows)


def linearise_simulated(model: Model, x: Array, whiteners: Sequence[Sequence[Whitener]]) -> tuple[Likelihood, Fit]:
    """Likelihood of the signals of a model at ``x`` as recordings, and the exact fit of the model to them."""
    runs = [
        replace(run, outputs=tuple(replace(o, data=signal) for o, signal in zip(run.outputs, signals, strict=True)))
        for run, signals in zip(model.runs, model.outputs(x), strict=True)
    ]
    likelihood = Likelihood(runs, whiteners)
    return likelihood, linearise_at(likelihood, Model(runs, model.device, model.candidates, model.mains), x)


def _finalise_fit(likelihood: Likelihood, model: Model, x: Array, residual: Array, jacobian: Array, rows: Mask) -> Fit:
    """A fit with its Laplace evidence."""
    chi2, penalty = float(residual[rows] @ residual[rows]), float(model.precision @ (x * x))
    information = jacobian[rows].T @ jacobian[rows]
    evidence = laplace_neg2_log_evidence(chi2 + penalty, information, model.precision**-0.5)
    evidence += sum(mains.cost for mains in model.mains) + sum(candidate.cost for candidate in model.candidates)
    held_out = likelihood.validation_rows, likelihood.validation_noise
    return Fit(model, x, chi2, penalty, residual, jacobian, rows, *held_out, evidence)
