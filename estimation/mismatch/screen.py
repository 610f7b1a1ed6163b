"""What each term could explain, to first order: columns of sensitivity with everything else projected out."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from estimation.mismatch.fit import POOL, Comparison, Fit
from estimation.mismatch.model import Candidate, Model
from scanner.device import Device
from scanner.terms import Parameter, Term
from scanner.terms.term import AMPLITUDES
from scanner.trajectory import LANES

Array = NDArray[np.float64]

PROMISING = 3.0
"""Fall of -2 log evidence by first order from which a candidate is fitted."""

AMISS = 2.0
"""Growth of chi-square from which a first-order step has left where first order holds."""

LARGEST = 3.0
"""Prior standard deviations that a first-order estimate may reach."""


@dataclass(frozen=True)
class Screened:
    """A candidate to first order around a fit.

    Attributes:
        candidate: what would be added.
        model: with it.
        x: where it was linearised: no size yet, at the best point of the term's own grid.
        step: the first-order estimate from there: its size, and what all else makes of that.
        gain: by how much -2 log evidence would fall.
        columns: sensitivities to its amplitudes, and to the first of them times each hidden state, per prior standard
            deviation, shape (N, q).
    """

    candidate: Candidate
    model: Model
    x: Array
    step: Array
    gain: float
    columns: Array


def all_candidates(device: Device, model: Model, terms: Iterable[Term]) -> list[Candidate]:
    """Every term on every axis and channel that could show it; one of a shared readout stands with the first axis."""
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
                    if not (term.on_channel and channel.partition(":")[0] not in kinds)
                    and not (repeated and channel.startswith("sense") and _of_readout(term))
                ]
    return found


BURST = 1e9
"""Change of the whitened residual by a unit of an amplitude from which the motion has burst its bounds (a force that
outweighs the spring): no first order holds there, and its square would drown all other columns."""


def _of_readout(term: Term) -> bool:
    """Whether a term changes what a readout gives, whichever axis it sees."""
    return term.stage in ("readout", "timing") and not term.of_axis


def starts(candidate: Candidate) -> list[tuple[float, ...]]:
    """Values of x to search from: zero for amplitudes, the term's own grid for the others."""
    return list(product(*[(0.0,) if is_amplitude(candidate, p) else p.starts for p in candidate.term.free]))


def is_amplitude(candidate: Candidate, parameter: Parameter) -> bool:
    """Whether a parameter is an amplitude from whose zero the effect follows to first order."""
    return parameter.kind in AMPLITUDES and not candidate.term.seeds


def screen(
    comparison: Comparison,
    base: Fit,
    candidates: Iterable[Candidate],
    stop: float = 1.0,
    gone: Sequence[Candidate] = (),
) -> list[Screened]:
    """The best start of every candidate by first order around ``base``.

    Args:
        gone: terms of ``base`` in whose place it would stand: ``base`` follows the motion, they need not be right.
    """
    return [max(found, key=lambda each: each.gain) for found in from_starts(comparison, base, candidates, stop, gone)]


def from_starts(
    comparison: Comparison,
    base: Fit,
    candidates: Iterable[Candidate],
    stop: float = 1.0,
    gone: Sequence[Candidate] = (),
) -> list[list[Screened]]:
    """As :func:`screen`, from every start of every candidate."""
    rows = base.rows & (comparison.time < stop)
    known = Projection(base, rows, gone)
    return list(POOL.map(lambda each: _from_starts(comparison, base, each, known, rows, stop), candidates))


def _from_starts(comparison: Comparison, base: Fit, candidate: Candidate, known: Projection, rows: NDArray[np.bool_],
                 stop: float) -> list[Screened]:  # fmt: skip
    model = Model(base.model.runs, base.model.device, (*base.model.candidates, candidate), base.model.mains)
    at = [i for i, f in enumerate(model.free) if f.kind == "term" and f.owner == candidate.key]
    moving, hidden = amplitudes(model, candidate), states(model, candidate)
    points, screened = [], []
    for grid, seed in product(starts(candidate), candidate.term.seeds or ((0.0,) * len(candidate.term.hidden),)):
        x = model.embed(base.model, base.x)
        x[at] = grid
        x[hidden] = seed * (len(hidden) // max(len(seed), 1))
        points.append(x)
    for first in range(0, len(points), LANES):
        some = points[first : first + LANES]
        if moving:
            found = _sensitivities(comparison, base, model, some, moving, hidden, rows, stop)
        else:  # nothing to follow from zero (a clip level, a mode that grows): what a finite size of it changes
            model.prepare(some, stop)
            found = [(comparison.residual(model, x, stop) - base.residual)[:, None] for x in some]
        for x, columns in zip(some, found, strict=True):
            normal, gradient, response = known.system(columns[rows])
            gain, estimate = gain_of(normal, gradient)
            step = np.zeros(x.size)
            if moving:
                estimate = np.clip(estimate, -LARGEST, LARGEST)
                step = model.embed(base.model, known.spread(response @ estimate))
                placed(step, model, candidate, estimate)
            elif estimate[0] <= 0.3:
                gain = 0.0
            screened.append(Screened(candidate, model, x, step, gain, columns))
    return screened


def placed(x: Array, model: Model, candidate: Candidate, estimate: Array) -> None:
    """Put first-order estimates of a candidate's amplitudes, and of the first times each hidden state, into ``x``."""
    moving, hidden = amplitudes(model, candidate), states(model, candidate)
    x[moving] = estimate[: len(moving)]
    if hidden and x[moving[0]]:
        x[hidden] = np.clip(estimate[len(moving) :] / x[moving[0]], -LARGEST, LARGEST)


def amplitudes(model: Model, candidate: Candidate) -> list[int]:
    """Where the amplitudes of a candidate stand in x."""
    return [
        i
        for i, f in enumerate(model.free)
        if f.parameter is not None and f.owner == candidate.key and is_amplitude(candidate, f.parameter)
    ]


def states(model: Model, candidate: Candidate) -> list[int]:
    """Where the hidden states of a candidate, at the start of every recording, stand in x."""
    return [i for i, f in enumerate(model.free) if f.kind == "hidden" and f.owner == candidate.key]


def stepped(comparison: Comparison, base: Fit, each: Screened, stop: float = 1.0) -> Array:
    """Where a fit starts: as much of the first-order step as leaves the misfit in its reach, at least a sixteenth."""
    rows = base.rows & (comparison.time < stop)
    level = AMISS * float(base.residual[rows] @ base.residual[rows])
    share = 1.0
    while share > 0.1:
        residual = comparison.residual(each.model, each.x + share * each.step, stop)[rows]
        if residual @ residual < level:
            break
        share *= 0.5
    return np.asarray(each.x + share * each.step)


def _sensitivities(comparison: Comparison, base: Fit, model: Model, points: Sequence[Array], moving: Sequence[int],
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
        model.prepare(list(changed.values()), stop)
        for (p, j), x in changed.items():
            yield p, j, comparison.residual(model, x, stop) - base.residual

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
        each[:, ~(np.linalg.norm(each[rows], axis=0) < BURST)] = 0.0
    return columns


class Projection:
    """What is left to explain around a fit once everything in it but the terms ``gone`` has been refitted to it.

    To first order: the residual is that of the fit without their part, and the columns of the others are projected out.
    """

    def __init__(self, base: Fit, rows: NDArray[np.bool_], gone: Sequence[Candidate] = ()):
        keys = {each.key for each in gone}
        self._kept = np.array([not (f.kind in ("term", "hidden") and f.owner in keys) for f in base.model.free])
        jacobian = base.jacobian[rows]
        self._old = jacobian[:, self._kept]
        self._residual = base.residual[rows] - jacobian[:, ~self._kept] @ base.x[~self._kept]
        precision = base.model.precision[self._kept]
        self._normal = self._old.T @ self._old + np.diag(precision)
        self._gradient = self._old.T @ self._residual + precision * base.x[self._kept]

    def system(self, new: Array) -> tuple[Array, Array, Array]:
        """What amplitudes of standard normal prior can do, from their columns (n, q), all else refitted.

        Returns:
            normal matrix (q, q), gradient (q,), and how the kept free numbers answer to the amplitudes, (p, q).
        """
        cross = self._old.T @ new
        try:
            solved = np.linalg.solve(self._normal, np.column_stack([cross, self._gradient]))
        except np.linalg.LinAlgError:  # the motion of the fit has burst its bounds: no first order holds around it
            return np.eye(new.shape[1]), np.zeros(new.shape[1]), np.zeros(cross.shape)
        normal = new.T @ new - cross.T @ solved[:, :-1] + np.eye(new.shape[1])
        return normal, new.T @ self._residual - cross.T @ solved[:, -1], -solved[:, :-1]

    def spread(self, change: Array) -> Array:
        """A change of the kept free numbers, (p,), as one of all."""
        whole = np.zeros(self._kept.size)
        whole[self._kept] = change
        return whole


def gain_of(normal: Array, gradient: Array) -> tuple[float, Array]:
    """Fall of -2 log evidence and estimate, from a normal matrix and a gradient."""
    estimate = np.asarray(-np.linalg.solve(normal, gradient))
    return float(-gradient @ estimate - np.linalg.slogdet(normal)[1]), estimate
