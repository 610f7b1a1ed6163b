"""First-order score of every candidate term: its sensitivities, with all fitted parameters projected out."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from estimation.diagnosis.fit import TRAJECTORY_POOL, Fit, Likelihood
from estimation.diagnosis.model import Candidate, Model
from scanner.arrays import Array
from scanner.device import Device
from scanner.integrator.runge_kutta import LANES
from scanner.terms import Parameter, Term
from scanner.terms.term import AMPLITUDE_KINDS

MIN_PREDICTED_GAIN = 3.0
"""Predicted fall of -2 log evidence from which a candidate is fitted: below ``DETECTION_THRESHOLD``, because a
prediction of first order may be too low."""

MAX_CHI2_GROWTH = 2.0
"""Growth of chi-square by a predicted step above which the step is halved: the model is not linear over it."""

MAX_PRIOR_SIGMAS = 3.0
"""Bound on a predicted amplitude in prior standard deviations. A larger one comes from extrapolating the linear
model."""


@dataclass(frozen=True)
class ScoreTest:
    """Score test of a candidate: its first-order effect around a fit.

    Attributes:
        candidate: the term.
        model: the fitted model with the term added.
        x: point of linearisation: amplitudes zero, other parameters at a point of the term's grid, shape (p,).
        step: first-order estimate of the change of all parameters from there, shape (p,).
        predicted_gain: predicted fall of -2 log evidence.
        columns: sensitivities to its amplitudes, and to the first of them times each hidden state, per prior standard
            deviation, shape (N, q).
    """

    candidate: Candidate
    model: Model
    x: Array
    step: Array
    predicted_gain: float
    columns: Array


def all_candidates(device: Device, model: Model, terms: Iterable[Term]) -> list[Candidate]:
    """Every term on every axis and channel where it applies; terms of a shared readout are on the first axis only."""
    found = []
    for axis in model.axes:
        scales = model.scales(axis)
        kinds = {output.kind for run in model.runs for output in run.outputs if axis in output.axes}
        repeated = device.readout is not None and axis != model.axes[0]
        for term in terms:
            if term.applies(device.axis(axis), scales):
                found += [
                    Candidate(term, axis, channel)
                    for channel in term.channels
                    if not (term.acts_on_channel and channel.partition(":")[0] not in kinds)
                    and not (repeated and channel.startswith("sense") and _changes_readout(term))
                ]
    return found


DIVERGED_SENSITIVITY = 1e9
"""Change of the whitened residual by a unit of an amplitude from which the trajectory has diverged, as under a force
that exceeds the spring's. Such a column is set to zero, because its square would exceed the precision of the others."""


def _changes_readout(term: Term) -> bool:
    """Whether a term acts on a readout as a whole and not on one of its axes."""
    return term.stage in ("readout", "timing") and not term.per_axis


def start_points(candidate: Candidate) -> list[tuple[float, ...]]:
    """Points of linearisation: zero for amplitudes, the grid of the term for other parameters."""
    return list(product(*[(0.0,) if is_amplitude(candidate, p) else p.starts for p in candidate.term.free_parameters]))


def is_amplitude(candidate: Candidate, parameter: Parameter) -> bool:
    """Whether the effect is linear in a parameter around zero."""
    return parameter.kind in AMPLITUDE_KINDS and not candidate.term.initial_seeds


def score_candidates(
    likelihood: Likelihood,
    base: Fit,
    candidates: Iterable[Candidate],
    stop: float = 1.0,
    removed: Sequence[Candidate] = (),
) -> list[ScoreTest]:
    """The score test with the largest predicted gain of every candidate, around ``base``.

    Args:
        removed: terms of ``base`` that the candidate would replace.
    """
    return [
        max(found, key=lambda each: each.predicted_gain)
        for found in score_candidate_starts(likelihood, base, candidates, stop, removed)
    ]


def score_candidate_starts(
    likelihood: Likelihood,
    base: Fit,
    candidates: Iterable[Candidate],
    stop: float = 1.0,
    removed: Sequence[Candidate] = (),
) -> list[list[ScoreTest]]:
    """As :func:`score_candidates`, from every start of every candidate."""
    rows = base.rows & (likelihood.time < stop)
    known = ProfiledLinearModel(base, rows, removed)
    return list(TRAJECTORY_POOL.map(lambda each: _score_starts(likelihood, base, each, known, rows, stop), candidates))


def _score_starts(
    likelihood: Likelihood,
    base: Fit,
    candidate: Candidate,
    known: ProfiledLinearModel,
    rows: NDArray[np.bool_],
    stop: float,
) -> list[ScoreTest]:
    model = Model(base.model.runs, base.model.device, (*base.model.candidates, candidate), base.model.mains)
    at = [i for i, f in enumerate(model.parameters) if f.kind == "term" and f.owner == candidate.key]
    moving, hidden = amplitude_indices(model, candidate), hidden_state_indices(model, candidate)
    points, screened = [], []
    for grid, seed in product(
        start_points(candidate), candidate.term.initial_seeds or ((0.0,) * len(candidate.term.hidden_state_scales),)
    ):
        x = model.map_parameters_from(base.model, base.x)
        x[at] = grid
        x[hidden] = seed * (len(hidden) // max(len(seed), 1))
        points.append(x)
    for first in range(0, len(points), LANES):
        some = points[first : first + LANES]
        if moving:
            found = _sensitivities(likelihood, base, model, some, moving, hidden, rows, stop)
        else:  # not linear around zero (a clip level, a mode that grows): the change by a finite size
            model.prefetch_trajectories(some, stop)
            found = [(likelihood.residual(model, x, stop) - base.residual)[:, None] for x in some]
        for x, columns in zip(some, found, strict=True):
            normal, gradient, response = known.normal_equations(columns[rows])
            gain, estimate = linear_gain(normal, gradient)
            step = np.zeros(x.size)
            if moving:
                estimate = np.clip(estimate, -MAX_PRIOR_SIGMAS, MAX_PRIOR_SIGMAS)
                step = model.map_parameters_from(base.model, known.expand(response @ estimate))
                set_amplitudes(step, model, candidate, estimate)
            elif estimate[0] <= 0.3:
                gain = 0.0
            screened.append(ScoreTest(candidate, model, x, step, gain, columns))
    return screened


def set_amplitudes(x: Array, model: Model, candidate: Candidate, estimate: Array) -> None:
    """Set a candidate's amplitudes and hidden states in ``x`` from estimates of amplitude and amplitude times state."""
    moving, hidden = amplitude_indices(model, candidate), hidden_state_indices(model, candidate)
    x[moving] = estimate[: len(moving)]
    if hidden and x[moving[0]]:
        x[hidden] = np.clip(estimate[len(moving) :] / x[moving[0]], -MAX_PRIOR_SIGMAS, MAX_PRIOR_SIGMAS)


def amplitude_indices(model: Model, candidate: Candidate) -> list[int]:
    """Indices in x of the amplitudes of a candidate."""
    return [
        i
        for i, f in enumerate(model.parameters)
        if f.parameter is not None and f.owner == candidate.key and is_amplitude(candidate, f.parameter)
    ]


def hidden_state_indices(model: Model, candidate: Candidate) -> list[int]:
    """Indices in x of the initial hidden states of a candidate, of all recordings."""
    return [i for i, f in enumerate(model.parameters) if f.kind == "hidden" and f.owner == candidate.key]


def damped_newton_start(likelihood: Likelihood, base: Fit, each: ScoreTest, stop: float = 1.0) -> Array:
    """Start of a fit: the first-order step, halved until chi-square grows by less than ``MAX_CHI2_GROWTH``."""
    rows = base.rows & (likelihood.time < stop)
    level = MAX_CHI2_GROWTH * float(base.residual[rows] @ base.residual[rows])
    share = 1.0
    while share > 0.1:
        residual = likelihood.residual(each.model, each.x + share * each.step, stop)[rows]
        if residual @ residual < level:
            break
        share *= 0.5
    return np.asarray(each.x + share * each.step)


def _sensitivities(likelihood: Likelihood, base: Fit, model: Model, points: Sequence[Array], moving: Sequence[int],
                   hidden: Sequence[int], rows: NDArray[np.bool_], stop: float) -> list[Array]:  # fmt: skip
    """At every one of ``points`` the derivatives of the whitened residual by the amplitudes ``moving`` and by the first
    of them times each of the ``hidden`` states, shape (N, q + h)."""
    shape = base.residual.size, len(moving) + len(hidden)
    columns, deltas = [np.empty(shape) for _ in points], np.full((len(points), len(moving)), 1e-3)

    def differences(asked: dict[tuple[int, int], dict[int, float]]) -> Iterator[tuple[int, int, Array]]:
        """Changes of the residual where single numbers of points are set to something else."""
        changed = {}
        for (p, j), numbers in asked.items():
            x = changed[p, j] = points[p].copy()
            x[list(numbers)] = list(numbers.values())
        model.prefetch_trajectories(list(changed.values()), stop)
        for (p, j), x in changed.items():
            yield p, j, likelihood.residual(model, x, stop) - base.residual

    left = list(np.ndindex(deltas.shape))
    for turn in range(2):
        asked, left = left, []
        for p, j, change in differences({(p, j): {moving[j]: points[p][moving[j]] + deltas[p, j]} for p, j in asked}):
            columns[p][:, j] = change / deltas[p, j]
            size = np.linalg.norm(columns[p][rows, j])
            if turn == 0 and not 0.05 < size * deltas[p, j] < 20.0:
                deltas[p, j] = np.clip(1.0 / size if size else 1e-2, 1e-6, 0.1)
                left.append((p, j))
    states_of = {
        (p, j): {moving[0]: x[moving[0]] + deltas[p, 0], i: 1.0}
        for p, x in enumerate(points)
        for j, i in enumerate(hidden, start=len(moving))
    }
    for p, j, change in differences(states_of):
        columns[p][:, j] = change / deltas[p, 0] - columns[p][:, 0]
    for each in columns:
        each[:, ~(np.linalg.norm(each[rows], axis=0) < DIVERGED_SENSITIVITY)] = 0.0
    return columns


class ProfiledLinearModel:
    """What is left to explain around a fit once everything in it but the terms ``removed`` has been refitted to it.

    To first order: the residual is that of the fit without their part, and the columns of the others are projected out.
    """

    def __init__(self, base: Fit, rows: NDArray[np.bool_], removed: Sequence[Candidate] = ()):
        keys = {each.key for each in removed}
        self._kept = np.array([not (f.kind in ("term", "hidden") and f.owner in keys) for f in base.model.parameters])
        jacobian = base.jacobian[rows]
        self._old = jacobian[:, self._kept]
        self._residual = base.residual[rows] - jacobian[:, ~self._kept] @ base.x[~self._kept]
        precision = base.model.precision[self._kept]
        self._normal = self._old.T @ self._old + np.diag(precision)
        self._gradient = self._old.T @ self._residual + precision * base.x[self._kept]

    def normal_equations(self, new: Array) -> tuple[Array, Array, Array]:
        """Normal equations of amplitudes with standard normal priors, with all other parameters refitted.

        Args:
            new: sensitivities to the amplitudes, shape (n, q).

        Returns:
            normal matrix, shape (q, q); gradient, (q,); change of the other parameters per amplitude, (p, q).
        """
        cross = self._old.T @ new
        try:
            solved = np.linalg.solve(self._normal, np.column_stack([cross, self._gradient]))
        except np.linalg.LinAlgError:  # the trajectory of the fit diverges, so it cannot be linearised
            return np.eye(new.shape[1]), np.zeros(new.shape[1]), np.zeros(cross.shape)
        normal = new.T @ new - cross.T @ solved[:, :-1] + np.eye(new.shape[1])
        return normal, new.T @ self._residual - cross.T @ solved[:, -1], -solved[:, :-1]

    def expand(self, change: Array) -> Array:
        """A change of the remaining parameters, shape (p,), as a change of all."""
        whole = np.zeros(self._kept.size)
        whole[self._kept] = change
        return whole


def linear_gain(normal: Array, gradient: Array) -> tuple[float, Array]:
    """Predicted fall of -2 log evidence, and estimate, shape (q,), of a linear model."""
    estimate = np.asarray(-np.linalg.solve(normal, gradient))
    return float(-gradient @ estimate - np.linalg.slogdet(normal)[1]), estimate
