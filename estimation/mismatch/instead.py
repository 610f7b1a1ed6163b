"""Other terms in a term's place: one or two that explain what it explains, found around a fit that follows the motion.

Where the nominal model has lost the motion, nothing can be linearised around it, and of two effects neither fits alone.
A free correction follows almost anything: around its fit, with its own part taken out again, first order tells which
named terms, single or in pairs, would do the same. The same way a named term is held against its look-alikes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimation.mismatch.fit import Comparison, Fit, solve_all
from estimation.mismatch.free import FREE
from estimation.mismatch.model import Candidate, Model
from estimation.mismatch.naming import HOPELESS, possible
from estimation.mismatch.screen import LARGEST, Projection, Screened, amplitudes, gain_of, placed, screen

Array = NDArray[np.float64]

TRIED = 4
"""Singles, and pairs, that are fitted."""


class Lead(NamedTuple):
    """A rival of a term.

    Attributes:
        behind: its distance behind in -2 log evidence.
        candidate: what it is.
        worse: by how much its fit is worse, whatever the price of its numbers.
    """

    behind: float
    candidate: Candidate
    worse: float


Leads = tuple[Lead, ...]

SWAPS = 4
"""Exchanges of one term for another before they count as settled."""


@dataclass(frozen=True)
class Settled:
    """A fit none of whose terms has a better one in its place.

    Attributes:
        fit: the best.
        leads: by term, the others tried in its place.
    """

    fit: Fit
    leads: dict[str, Leads]


def instead(
    comparison: Comparison, fit: Fit, gone: Sequence[Candidate], pool: Sequence[Candidate], pairs: bool = False
) -> list[Fit]:
    """Fits with other terms of ``pool`` in the place of ``gone``, best first; with ``pairs``, two of them as well."""
    taken = {each.key for each in fit.model.candidates}
    seen = screen(comparison, fit, [each for each in pool if each.key not in taken], gone=gone)
    seen = [each for each in seen if np.any(each.columns)]
    if not seen:
        return []
    ends = np.cumsum([0, *(each.columns.shape[1] for each in seen)])
    columns = np.column_stack([s.columns[fit.rows] for s in seen])
    normal, gradient, _ = Projection(fit, fit.rows, gone).system(columns)

    def promise(group: tuple[int, ...]) -> tuple[float, Array]:
        at = np.concatenate([np.arange(ends[i], ends[i + 1]) for i in group])
        gain, estimate = gain_of(normal[np.ix_(at, at)], gradient[at])
        return gain, np.clip(estimate, -LARGEST, LARGEST)

    starts = []
    for size in (1, 2) if pairs else (1,):
        promised = [(*promise(group), group) for group in combinations(range(len(seen)), size)]
        promised.sort(key=lambda each: -each[0])
        for place, (_, estimate, group) in enumerate(promised):
            if place < TRIED or (size == 1 and any(_akin(seen[group[0]].candidate, each) for each in gone)):
                starts.append(_start(fit, gone, [seen[i] for i in group], estimate))
    # Around a free correction the way is far; around a named fit, what is not soon as good never will be.
    fits = solve_all(comparison, starts, turns=20 if pairs else 8, hopeless=fit.evidence + HOPELESS)
    return sorted((each for each in fits if possible(each)), key=lambda each: each.evidence)


def _akin(one: Candidate, other: Candidate) -> bool:
    """Whether two terms are known for taking each other's place, as every law of a stage may take that of its free
    correction: where they are large, first order may miss it."""
    if other.term.effect in FREE:
        return one.term.stage == other.term.stage
    return other.term.effect in one.term.lookalikes or one.term.effect in other.term.lookalikes


def _start(fit: Fit, gone: Sequence[Candidate], added: Sequence[Screened], estimate: Array) -> tuple[Model, Array]:
    """The model with ``added`` in the place of ``gone``, and where to start its fit.

    All else starts as it was: what stood in ``gone`` is large, and no first order tells how far the others would go.
    """
    kept = [each for each in fit.model.candidates if each not in gone]
    model = Model(fit.model.runs, fit.model.device, [*kept, *(s.candidate for s in added)], fit.model.mains)
    x = model.embed(fit.model, fit.x)
    first = 0
    for each in added:
        own = [i for i, f in enumerate(model.free) if f.kind == "term" and f.owner == each.candidate.key]
        x[own] = [each.x[each.model.index("term", each.candidate.key, model.free[i].name)] for i in own]
        width = each.columns.shape[1]
        if amplitudes(model, each.candidate):
            placed(x, model, each.candidate, estimate[first : first + width])
        first += width
    return model, x


def behind(best: Fit, others: Sequence[Fit]) -> Leads:
    """The newest terms of ``others``, each with its distance behind ``best``."""
    least = best.chi2 + best.penalty
    return tuple(
        Lead(fit.evidence - best.evidence, fit.model.candidates[-1], fit.chi2 + fit.penalty - least) for fit in others
    )


def settled(comparison: Comparison, fit: Fit, pool: Sequence[Candidate], newest: int) -> Settled:
    """Exchange each of the ``newest`` last terms for a better one as long as there is one."""
    leads: dict[str, Leads] = {}
    for _ in range(SWAPS):
        leads = {}
        better = None
        for each in fit.model.candidates[len(fit.model.candidates) - newest :]:
            others = instead(comparison, fit, (each,), pool)
            if others and others[0].evidence < fit.evidence - 0.1:
                better = others[0]
                break
            leads[each.key] = behind(fit, others)
        if better is None:
            break
        fit = better
    return Settled(fit, leads)
