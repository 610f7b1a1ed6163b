"""What each term could explain, to first order: columns of sensitivity with everything else projected out."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from estimation.mismatch.fit import Comparison, Fit
from estimation.mismatch.model import Candidate, Model
from scanner.device import Device
from scanner.terms import Term
from scanner.terms.term import AMPLITUDES

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Screened:
    """A candidate to first order around a fit.

    Attributes:
        candidate: what would be added.
        model: with it.
        x: start of a fit, with the first-order estimate of its size.
        gain: by how much -2 log evidence would fall.
        columns: sensitivities to its amplitudes, per prior standard deviation, shape (N, q).
    """

    candidate: Candidate
    model: Model
    x: Array
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


def _of_readout(term: Term) -> bool:
    """Whether a term changes what a readout gives, whichever axis it sees."""
    return term.stage in ("readout", "timing") and not term.of_axis


def starts(candidate: Candidate) -> list[tuple[float, ...]]:
    """Values of x to search from: zero for amplitudes, the term's own grid for the others."""
    return list(product(*[(0.0,) if p.kind in AMPLITUDES else p.starts for p in candidate.term.free]))


def screen(comparison: Comparison, base: Fit, candidate: Candidate, stop: float = 1.0) -> Screened:
    """The best start of a candidate by first order around ``base``."""
    model = Model(base.model.runs, base.model.device, (*base.model.candidates, candidate), base.model.mains)
    rows = base.rows & (comparison.time < stop)
    best: Screened | None = None
    for grid in starts(candidate):
        x = model.embed(base.model, base.x)
        at = [i for i, f in enumerate(model.free) if f.kind == "term" and f.owner == candidate.key]
        x[at] = grid
        moving = [i for i in at if model.free[i].parameter.kind in AMPLITUDES]  # type: ignore[union-attr]
        found = (
            _first_order(comparison, base, candidate, model, x, moving, rows, stop)
            if moving
            else _at_a_point(comparison, base, candidate, model, x, rows, stop)
        )
        if best is None or found.gain > best.gain:
            best = found
    assert best is not None
    return best


def _first_order(comparison: Comparison, base: Fit, candidate: Candidate, model: Model, x: Array, moving: Sequence[int],
                 rows: NDArray[np.bool_], stop: float) -> Screened:  # fmt: skip
    columns = np.empty((base.residual.size, len(moving)))
    for j, i in enumerate(moving):
        delta = 1e-3
        for _ in range(2):
            moved = x.copy()
            moved[i] += delta
            columns[:, j] = (comparison.residual(model, moved, stop) - base.residual) / delta
            size = np.linalg.norm(columns[rows, j])
            if 0.05 < size * delta < 20.0:
                break
            delta = float(np.clip(1.0 / size if size else 1e-2, 1e-6, 0.1))
    gain, estimate = _gain(base, columns, rows)
    x = x.copy()
    x[list(moving)] = np.clip(estimate, -3.0, 3.0)
    return Screened(candidate, model, x, gain, columns)


def _at_a_point(comparison: Comparison, base: Fit, candidate: Candidate, model: Model, x: Array,
                rows: NDArray[np.bool_], stop: float) -> Screened:  # fmt: skip
    """A term without an amplitude (a clip level): what a finite size of it changes."""
    column = (comparison.residual(model, x, stop) - base.residual)[:, None]
    gain, share = _gain(base, column, rows)
    return Screened(candidate, model, x, gain if share[0] > 0.3 else 0.0, column)


def _gain(base: Fit, columns: Array, rows: NDArray[np.bool_]) -> tuple[float, Array]:
    """Fall of -2 log evidence and estimate of the new amplitudes, all other free numbers refitted to first order."""
    old, new = base.jacobian[rows], columns[rows]
    normal = old.T @ old + np.diag(base.model.precision)
    cross = old.T @ new
    gradient = old.T @ base.residual[rows] + base.model.precision * base.x
    kept = new.T @ new - cross.T @ np.linalg.solve(normal, cross)
    push = new.T @ base.residual[rows] - cross.T @ np.linalg.solve(normal, gradient)
    inner = kept + np.eye(new.shape[1])
    estimate = np.asarray(-np.linalg.solve(inner, push))
    return float(-push @ estimate - np.linalg.slogdet(inner)[1]), estimate
