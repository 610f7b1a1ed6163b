"""Output-error fit: the free numbers that bring simulated channels closest to recorded ones, priors included.

Trajectories are fitted, not derivatives: the start of every recording is free, windows grow from a few turns of the
mirror to the whole, and every residual is whitened by the noise that was measured.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation.mismatch.experiment import Run
from estimation.mismatch.model import Model
from estimation.mismatch.noise import Whitener

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

POOL = ThreadPoolExecutor(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count())
"""For independent trajectories: compiled code and numpy let go of the interpreter."""

ABREAST = 2
"""Fits at a time; the same on every machine, for a race drops those that lag behind the ones before them."""

FITTING = ThreadPoolExecutor(ABREAST)
"""For independent fits, which wait for ``POOL`` and may not run in it."""

FOLDS = 20
"""Blocks of time that a recording is cut into; every ``HELD``-th is held out of every fit."""

HELD = 5

FAR_OFF = 100.0
"""Misfit over the one that is no hope, from which a fit has lost the motion: it has less time to come down."""

KEPT = 0.9
"""Share of the gain that first order promises, from which a Jacobian serves for another step."""


@dataclass(frozen=True)
class Fit:
    """A model fitted.

    Attributes:
        model: what was fitted.
        x: free numbers at the best fit.
        chi2: of the fitted samples; ``penalty``: of the priors.
        residual: whitened, all samples of all channels, shape (N,).
        jacobian: of the whitened residual, shape (N, len(x)).
        rows: fitted samples; ``held``: held-out ones.
        evidence: -2 log evidence (Laplace): chi2 + penalty + the price of the free numbers. Less is better.
    """

    model: Model
    x: Array
    chi2: float
    penalty: float
    residual: Array
    jacobian: Array
    rows: Mask
    held: Mask
    evidence: float

    @property
    def covariance(self) -> Array:
        """Posterior covariance of x."""
        inverse = np.linalg.inv(self.jacobian[self.rows].T @ self.jacobian[self.rows] + np.diag(self.model.precision))
        return np.asarray(inverse)

    @property
    def held_chi2(self) -> float:
        """Reduced chi-square of held-out samples."""
        return float(np.mean(self.residual[self.held] ** 2))


class Comparison:
    """Whitened residuals of a model against recordings, with the samples that are fitted and those held out.

    Attributes:
        runs, whiteners: channels in order, one whitener each, by run.
        rows, held: masks over all whitened samples.
        time: of every whitened sample as a fraction of its recording.
        channel: index of its channel, counted over all runs.
    """

    def __init__(self, runs: Sequence[Run], whiteners: Sequence[Sequence[Whitener]]):
        self.runs, self.whiteners = tuple(runs), tuple(tuple(w) for w in whiteners)
        flat = [w for run in self.whiteners for w in run]
        self.time = np.concatenate([w.time for w in flat])
        self.channel = np.concatenate([np.full(w.samples, i) for i, w in enumerate(flat)])
        keep = np.concatenate([w.keep for w in flat])
        held = (np.floor(self.time * FOLDS).astype(int) % HELD) == HELD // 2
        self.rows, self.held = keep & ~held, keep & held
        self._whitened: dict[tuple[int, str, str, float], Array] = {}

    def fitted(self, stop: float) -> Mask:
        """Rows of a fit up to the fraction ``stop`` of the recordings: short of where the whitening feels that end."""
        return self.rows & (self.time < 0.98 * stop) if stop < 1.0 else self.rows

    def residual(self, model: Model, x: Array, stop: float = 1.0) -> Array:
        """Whitened data minus model, shape (N,); beyond ``stop`` it is zero.

        Where a trajectory runs away, the residual is huge: a trial step like any other that is not taken.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            return self._residual(model, x, stop)

    def excused(self, fit: Fit) -> float:
        """What of a fit's chi-square slow noise beyond the measured one may be, see ``Whitener.excused``."""
        total, first = 0.0, 0
        shown = np.where(fit.rows, fit.residual, 0.0)
        for whiten in (each for run in self.whiteners for each in run):
            if whiten.first > 1.0:
                total += whiten.excused(shown[first : first + whiten.samples])
            first += whiten.samples
        return total

    def _residual(self, model: Model, x: Array, stop: float) -> Array:
        parts = []
        for run, whiteners, signals in zip(self.runs, self.whiteners, model.outputs(x, stop), strict=True):
            for output, whiten, signal in zip(run.outputs, whiteners, signals, strict=True):
                difference = np.zeros(output.data.size)
                difference[: signal.size] = output.data[: signal.size] - signal
                parts.append(whiten(difference))
        whole = np.concatenate(parts)
        return np.where(np.abs(whole) < 1e100, whole, 1e6)  # its square must be a number as well

    def _additive(self, model: Model, stop: float) -> dict[int, Array]:
        """Columns of the free numbers that only add to a channel: the same at any x."""
        columns: dict[int, Array] = {}
        first = 0
        for r, (run, whiteners) in enumerate(zip(self.runs, self.whiteners, strict=True)):
            for output, whiten in zip(run.outputs, whiteners, strict=True):
                for i, values in zip(*model.basis[(r, output.name)], strict=True):
                    key = (r, output.name, model.free[i].name, stop)
                    if key not in self._whitened:
                        shown = -values.copy()
                        shown[int(stop * values.size) if stop < 1.0 else values.size :] = 0.0
                        self._whitened[key] = whiten(shown)
                    columns[i] = np.zeros(self.time.size)
                    columns[i][first : first + whiten.samples] = self._whitened[key]
                first += whiten.samples
        return columns

    def jacobian(self, model: Model, x: Array, base: Array, steps: Array, stop: float = 1.0) -> Array:
        """Derivatives of the residual by one-sided differences; ``steps`` adapts in place to a change of 0.3."""
        columns = np.empty((x.size, base.size)).T  # column by column, as they are filled
        additive = self._additive(model, stop)
        for i, column in additive.items():
            columns[:, i] = column

        moved = {}
        for i in set(range(x.size)) - set(additive):
            moved[i] = x.copy()
            moved[i][i] += steps[i]
        model.prepare(list(moved.values()), stop, POOL.map)

        def fill(i: int) -> None:
            columns[:, i] = (self.residual(model, moved[i], stop) - base) / steps[i]
            size = np.linalg.norm(columns[:, i])
            steps[i] = np.clip(0.3 / size if size else 1e-2, 1e-7, 3e-2)

        list(POOL.map(fill, moved))
        return columns


def solve(
    comparison: Comparison,
    model: Model,
    x: Array,
    stop: float = 1.0,
    turns: int = 12,
    steps: Array | None = None,
    tolerance: float = 0.05,
    hopeless: float = np.inf,
    fixed: int | None = None,
) -> Fit:
    """Levenberg-Marquardt on the fitted samples up to the fraction ``stop`` of the recordings.

    Args:
        x: where to start.
        turns: Jacobians at most.
        steps: difference steps, adapted in place.
        tolerance: stop when a step lowers chi-square by less.
        hopeless: stop when chi-square is still above and no longer comes down towards it.
        fixed: which of x stays as it is.
    """
    steps = np.full(x.size, 1e-4) if steps is None else steps
    rows = comparison.fitted(stop)
    precision = model.precision
    residual = comparison.residual(model, x, stop)
    value = residual[rows] @ residual[rows] + precision @ (x * x)
    damping = 1e-4
    jacobian, fresh = comparison.jacobian(model, x, residual, steps, stop), True
    turn = 0
    while True:
        part = jacobian[rows]
        normal = part.T @ part + np.diag(precision)
        gradient = part.T @ residual[rows] + precision * x
        if fixed is not None:
            normal[fixed], normal[:, fixed], normal[fixed, fixed], gradient[fixed] = 0.0, 0.0, 1.0, 0.0
        gain = promised = 0.0
        while damping < 1e8:
            try:
                step = -np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient)
            except np.linalg.LinAlgError:  # of a motion that has burst its bounds
                damping *= 6.0
                continue
            tried = comparison.residual(model, x + step, stop)
            new = tried[rows] @ tried[rows] + precision @ ((x + step) ** 2)
            if new < value:
                gain, value, residual, x = value - new, new, tried, x + step
                promised = -float(step @ (2.0 * gradient + normal @ step))
                damping = max(damping / 8.0, 1e-9)
                break
            if gradient @ -step < 0.1 * tolerance:
                break
            damping *= 6.0
        if fresh and gain < tolerance and turn > 0:
            break
        # The Jacobian takes nearly all the time: while steps hold what it promises, it need not be known anew.
        fresh = gain <= KEPT * promised or gain <= tolerance
        if fresh:
            turn += 1
            jacobian = comparison.jacobian(model, x, residual, steps, stop)
            patience = 2 if value > FAR_OFF * hopeless else 4
            if turn == turns or (turn > patience and gain < 0.2 * (value - hopeless)):
                break
    return _made(comparison, model, x, residual, jacobian, rows)


def solve_all(
    comparison: Comparison,
    starts: Iterable[tuple[Model, Array]],
    stop: float = 1.0,
    turns: int = 12,
    tolerance: float = 0.05,
    hopeless: float = np.inf,
) -> list[Fit]:
    """:func:`solve` from every one of ``starts``, ``ABREAST`` at a time."""

    def one(start: tuple[Model, Array]) -> Fit:
        return solve(comparison, *start, stop, turns, tolerance=tolerance, hopeless=hopeless)

    return list(FITTING.map(one, starts))


def unmoved(comparison: Comparison, model: Model, x: Array, stop: float = 1.0) -> Fit:
    """The model at ``x`` as it stands, for what is first order around it."""
    residual, steps = comparison.residual(model, x, stop), np.full(x.size, 1e-4)
    for _ in range(2):  # the second time with steps of the right size
        jacobian = comparison.jacobian(model, x, residual, steps, stop)
    return _made(comparison, model, x, residual, jacobian, comparison.fitted(stop))


def _made(comparison: Comparison, model: Model, x: Array, residual: Array, jacobian: Array, rows: Mask) -> Fit:
    """A fit with its evidence by Laplace's method."""
    chi2, penalty = float(residual[rows] @ residual[rows]), float(model.precision @ (x * x))
    evidence = laplace(chi2 + penalty, jacobian[rows].T @ jacobian[rows], model.precision)
    return Fit(model, x, chi2, penalty, residual, jacobian, rows, comparison.held, evidence)


def laplace(misfit: float, information: Array, precision: Array) -> float:
    """-2 log evidence of a misfit, priors included: ``information`` prices the numbers against their priors' widths."""
    scaled = information / np.sqrt(np.outer(precision, precision))
    return misfit + float(np.linalg.slogdet(np.eye(len(precision)) + scaled)[1])
