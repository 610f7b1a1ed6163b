"""What a recording can tell: every effect's size in sigma, and how far it stands from its nearest look-alike.

The sensitivities are those of the whitened channels with everything nominal projected out. Two effects that lie d sigma
apart are told apart with probability about Phi(d/2): 95 % at 3.3; one is named alone from 4.5 on.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation.mismatch.fit import Comparison, Fit
from estimation.mismatch.screen import Screened, all_candidates, screen
from scanner.terms import Term

Array = NDArray[np.float64]

APART = 4.5
"""Distance [sigma] from which an effect is named alone."""


@dataclass(frozen=True)
class Visible:
    """How well one effect of its natural size shows.

    Attributes:
        key: the effect, with axis and channel.
        sigma: its size.
        nearest: the effect that imitates it best.
        distance: what is left of it after that and all nominal values have done their best [sigma].
    """

    key: str
    sigma: float
    nearest: str
    distance: float


def visibility(comparison: Comparison, fit: Fit, terms: Iterable[Term]) -> list[Visible]:
    """Every effect around ``fit``, the clearest first; effects already in it are left out."""
    taken = {each.key for each in fit.model.candidates}
    candidates = [c for c in all_candidates(fit.model.device, fit.model, terms) if c.key not in taken]
    screened = [each for each in (screen(comparison, fit, c) for c in candidates) if np.any(each.columns)]
    seen, apart = distances(fit, screened, comparison.rows)
    found = []
    for i, each in enumerate(screened):
        others = [j for j, other in enumerate(screened) if other.candidate.term.effect != each.candidate.term.effect]
        nearest = min(others, key=lambda j: apart[i, j], default=i)
        found.append(
            Visible(each.candidate.key, float(seen[i]), screened[nearest].candidate.key, float(apart[i, nearest]))
        )
    return sorted(found, key=lambda each: -each.sigma)


def distances(fit: Fit, screened: list[Screened], rows: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Sizes and distances of effects of their natural size.

    Returns:
        (size [sigma], shape (n,); distance of effect i to effect j [sigma], shape (n, n)).
    """
    old = fit.jacobian[rows]
    normal = old.T @ old + np.diag(fit.model.precision)
    blocks = [each.columns[rows] for each in screened]
    ends = np.cumsum([0, *(block.shape[1] for block in blocks)])
    whole = np.column_stack(blocks)
    cross = old.T @ whole
    gram = whole.T @ whole - cross.T @ np.linalg.solve(normal, cross)  # nominal values projected out
    signals = np.zeros((len(blocks), whole.shape[1]))
    for i in range(len(blocks)):
        signals[i, ends[i] : ends[i + 1]] = 1.0 / np.sqrt(blocks[i].shape[1])
    overlap = signals @ gram
    size = np.sqrt(np.maximum(np.einsum("ij,ij->i", overlap, signals), 0.0))
    apart = np.empty((len(blocks), len(blocks)))
    for j in range(len(blocks)):
        part = slice(ends[j], ends[j + 1])
        inner = gram[part, part] + np.eye(blocks[j].shape[1])
        explained = np.einsum("ij,ji->i", overlap[:, part], np.linalg.solve(inner, overlap[:, part].T))
        apart[:, j] = np.sqrt(np.maximum(size**2 - explained, 0.0))
    return size, apart
