"""First-order score of every candidate term: its sensitivities, with all fitted parameters projected out."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from estimation.device_fit.fit import Fit, Likelihood
from estimation.device_fit.model import Model
from estimation.device_fit.parameters import Candidate
from estimation.parallel import map_parallel
from scanner.arrays import Array
from scanner.integrator.abi import LANES
from scanner.terms import Parameter, Term
from scanner.terms.term import AMPLITUDE_KINDS

MAX_CHI2_GROWTH = 2.0
"""Growth of chi-square by a predicted step above which the step is halved: the model is not linear over it."""

MAX_PRIOR_SIGMAS = 3.0
"""Bound on a predicted amplitude in prior standard deviations. Larger predictions are extrapolations of the linear
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


def all_candidates(model: Model, terms: Iterable[Term]) -> list[Candidate]:
    """Every term on every axis and channel where it applies and the integrator takes it beside those of the model.

    Terms of a shared readout are on the first axis only.
    """
    device, candidates = model.device, list[Candidate]()
    for axis in model.axes:
        scales = model.scales(axis)
        kinds = {output.kind for run in model.runs for output in run.outputs if axis in output.axes}
        on_later_axis = device.readout is not None and axis != model.axes[0]
        for term in terms:
            if term.applies(device.axis(axis), scales) and model.has_room_for(axis, term):
                candidates += [
                    Candidate(term, axis, channel)
                    for channel in term.channels
                    if not (term.acts_on_channel and channel.partition(":")[0] not in kinds)
                    and not (on_later_axis and channel.startswith("sense") and _changes_readout(term))
                ]
    return candidates


DIVERGED_SENSITIVITY = 1e9
"""Norm of a sensitivity from which the trajectory has diverged, as under a force that exceeds that of the spring. Such
a column is set to zero, because its square would exceed the numerical precision of the others."""


def _changes_readout(term: Term) -> bool:
    """Whether a term acts on a readout as a whole and not on one of its axes."""
    return term.stage in ("readout", "timing") and not term.per_axis


def is_amplitude(candidate: Candidate, parameter: Parameter) -> bool:
    """Whether the effect is linear in a parameter around zero."""
    return parameter.kind in AMPLITUDE_KINDS and not candidate.term.initial_seeds


def is_linear(candidate: Candidate) -> bool:
    """Whether a term is linear in an amplitude around zero."""
    return any(is_amplitude(candidate, parameter) for parameter in candidate.term.free_parameters)


def score_candidate_starts(
    likelihood: Likelihood, base: Fit, candidates: Iterable[Candidate], stop: float = 1.0
) -> list[list[ScoreTest]]:
    """Score tests of every candidate around ``base``, at each of its points of linearisation.

    Args:
        stop: end of the window of ``base`` as a fraction of the recordings.
    """
    profiled = ProfiledLinearModel(base)
    return map_parallel(
        lambda candidate: _score_starts(likelihood, base, candidate, profiled, stop), candidates, likelihood.steps
    )


def _score_starts(
    likelihood: Likelihood, base: Fit, candidate: Candidate, profiled: ProfiledLinearModel, stop: float
) -> list[ScoreTest]:
    model = base.model.with_candidates((*base.model.candidates, candidate))
    indices = model.indices("term", candidate.key)
    amplitudes, hidden_states = amplitude_indices(model, candidate), model.indices("hidden", candidate.key)
    term, points, scores = candidate.term, [], []
    grid = product(*[(0.0,) if is_amplitude(candidate, p) else p.starts for p in term.free_parameters])
    for values, seed in product(grid, term.initial_seeds or ((0.0,) * len(term.hidden_state_scales),)):
        x = model.map_parameters_from(base.model, base.x)
        x[indices] = values
        x[hidden_states] = seed * (len(hidden_states) // max(len(seed), 1))
        points.append(x)
    for first in range(0, len(points), LANES):
        batch = points[first : first + LANES]
        if amplitudes:
            sensitivities = _sensitivities(likelihood, base, model, batch, amplitudes, hidden_states, stop)
        else:  # not linear around zero (a clip level, a mode that grows): the change by a finite size
            model.prefetch_trajectories(batch, stop)
            sensitivities = [(likelihood.residual(model, x, stop) - base.residual)[:, None] for x in batch]
        for x, columns in zip(batch, sensitivities, strict=True):
            normal, gradient, response = profiled.normal_equations(columns[base.rows])
            gain, estimate = predict_gain(normal, gradient)
            step = np.zeros(x.size)
            if amplitudes:
                estimate = np.clip(estimate, -MAX_PRIOR_SIGMAS, MAX_PRIOR_SIGMAS)
                step = model.map_parameters_from(base.model, response @ estimate)
                set_amplitudes(step, model, candidate, estimate)
            elif estimate[0] <= 0.3:
                gain = 0.0
            scores.append(ScoreTest(candidate, model, x, step, gain, columns))
    return scores


def set_amplitudes(x: Array, model: Model, candidate: Candidate, estimate: Array) -> None:
    """Set a candidate's amplitudes and hidden states in ``x`` from estimates of amplitude and amplitude times state.

    Hidden states without an estimate, those of a candidate that the fit already contains, keep their values.
    """
    amplitudes, hidden_states = amplitude_indices(model, candidate), model.indices("hidden", candidate.key)
    x[amplitudes] = estimate[: len(amplitudes)]
    states = estimate[len(amplitudes) :]
    if states.size and x[amplitudes[0]]:
        x[hidden_states] = np.clip(states / x[amplitudes[0]], -MAX_PRIOR_SIGMAS, MAX_PRIOR_SIGMAS)


def amplitude_indices(model: Model, candidate: Candidate) -> list[int]:
    """Indices in x of the amplitudes of a candidate."""
    return [
        i
        for i, f in enumerate(model.parameters)
        if f.parameter is not None and f.owner == candidate.key and is_amplitude(candidate, f.parameter)
    ]


def damped_start(likelihood: Likelihood, base: Fit, model: Model, x: Array, step: Array) -> Array:
    """Start of a fit: ``x`` and a step, halved until chi-square exceeds that of ``base`` by less than a factor of
    ``MAX_CHI2_GROWTH``."""
    max_chi2 = MAX_CHI2_GROWTH * base.chi2
    fraction = 1.0
    while fraction > 0.1:
        residual = likelihood.residual(model, x + fraction * step)[base.rows]
        if residual @ residual < max_chi2:
            break
        fraction *= 0.5
    return np.asarray(x + fraction * step)


def _sensitivities(likelihood: Likelihood, base: Fit, model: Model, points: Sequence[Array], amplitudes: Sequence[int],
                   hidden_states: Sequence[int], stop: float) -> list[Array]:  # fmt: skip
    """At every one of ``points`` the derivatives of the whitened residual by the amplitudes and by the first
    of them times each of the hidden states, shape (N, q + h)."""
    shape = base.residual.size, len(amplitudes) + len(hidden_states)
    columns, deltas = [np.empty(shape) for _ in points], np.full((len(points), len(amplitudes)), 1e-3)

    def differences(changes: dict[tuple[int, int], dict[int, float]]) -> Iterator[tuple[int, int, Array]]:
        """Change of the residual for each key (point, column) if the given parameters of that point are changed."""
        changed = {}
        for (p, j), numbers in changes.items():
            x = changed[p, j] = points[p].copy()
            x[list(numbers)] = list(numbers.values())
        model.prefetch_trajectories(list(changed.values()), stop)
        for (p, j), x in changed.items():
            yield p, j, likelihood.residual(model, x, stop) - base.residual

    pending = list(np.ndindex(deltas.shape))
    for attempt in range(2):
        requested, pending = pending, []
        for p, j, change in differences(
            {(p, j): {amplitudes[j]: points[p][amplitudes[j]] + deltas[p, j]} for p, j in requested}
        ):
            columns[p][:, j] = change / deltas[p, j]
            norm = np.linalg.norm(columns[p][base.rows, j])
            if attempt == 0 and not 0.05 < norm * deltas[p, j] < 20.0:
                deltas[p, j] = np.clip(1.0 / norm if norm else 1e-2, 1e-6, 0.1)
                pending.append((p, j))
    states_of = {
        (p, j): {amplitudes[0]: x[amplitudes[0]] + deltas[p, 0], i: 1.0}
        for p, x in enumerate(points)
        for j, i in enumerate(hidden_states, start=len(amplitudes))
    }
    for p, j, change in differences(states_of):
        columns[p][:, j] = change / deltas[p, 0] - columns[p][:, 0]
    for column_block in columns:
        column_block[:, ~(np.linalg.norm(column_block[base.rows], axis=0) < DIVERGED_SENSITIVITY)] = 0.0
    return columns


class ProfiledLinearModel:
    """Linear model of the residual of a fit, with all of its parameters projected out.

    Additional columns are fitted jointly with the parameters (profiled), so that only their orthogonal part counts.
    """

    def __init__(self, base: Fit):
        self._jacobian, self._residual = base.jacobian[base.rows], base.residual[base.rows]
        self._normal = self._jacobian.T @ self._jacobian + np.diag(base.model.precision)
        self._gradient = self._jacobian.T @ self._residual + base.model.precision * base.x

    def normal_equations(self, columns: Array) -> tuple[Array, Array, Array]:
        """Normal equations of amplitudes with standard normal priors, with all other parameters refitted.

        Args:
            columns: sensitivities to the amplitudes, shape (n, q).

        Returns:
            normal matrix, shape (q, q); gradient, (q,); change of the other parameters per amplitude, (p, q).
        """
        cross = self._jacobian.T @ columns
        try:
            solved = np.linalg.solve(self._normal, np.column_stack([cross, self._gradient]))
        except np.linalg.LinAlgError:  # the trajectory of the fit diverges, so it cannot be linearised
            return np.eye(columns.shape[1]), np.zeros(columns.shape[1]), np.zeros(cross.shape)
        normal = columns.T @ columns - cross.T @ solved[:, :-1] + np.eye(columns.shape[1])
        return normal, columns.T @ self._residual - cross.T @ solved[:, -1], np.asarray(-solved[:, :-1])


def predict_gain(normal: Array, gradient: Array) -> tuple[float, Array]:
    """Predicted fall of -2 log evidence, and estimate, shape (q,), of a linear model."""
    estimate = np.asarray(-np.linalg.solve(normal, gradient))
    return float(-gradient @ estimate - np.linalg.slogdet(normal)[1]), estimate
