"""Exchange moves of the selection: replace a term by one or two others that explain the same data.

If the phase error of the nominal model is large, the model cannot be linearised around it, and if two effects act,
neither of them fits alone. A discrepancy term fits nearly any effect. Around its fit, with its contribution removed,
first-order scores rank the named terms, single and in pairs. The same exchange compares a named term with its
confounders.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np

from estimation.diagnosis.discrepancy import DISCREPANCY_TERMS
from estimation.diagnosis.fit import Fit, Likelihood, fit_models
from estimation.diagnosis.model import Model
from estimation.diagnosis.parameters import Candidate
from estimation.diagnosis.progressive_fit import ABORT_MARGIN
from estimation.diagnosis.screening import (
    MAX_PRIOR_SIGMAS,
    ProfiledLinearModel,
    ScoreTest,
    amplitude_indices,
    linear_gain,
    score_candidates,
    set_amplitudes,
)
from estimation.diagnosis.significance import satisfies_sign_constraints
from scanner.arrays import Array

MAX_EXCHANGE_FITS = 4
"""Numbers of single terms, and of pairs, with the largest predicted gains that are fitted instead of a term. They bound
the computing time."""

MAX_EXCHANGES = 4
"""Largest number of exchanges of one term for another. It bounds the computing time; every exchange lowers -2 log
evidence, so the sequence converges in any case."""

MIN_EXCHANGE_GAIN = 0.1
"""Decrease of -2 log evidence from which a term is exchanged: twice the tolerance of a fit."""

PAIR_ITERATIONS, EXCHANGE_ITERATIONS = 20, 8
"""Largest numbers of iterations of a fit that replaces a discrepancy term, which starts far from the minimum, and of
one that replaces a named term: a confounder that fits as well as the term has converged by then."""


class RivalFit(NamedTuple):
    """A rival of a term.

    Attributes:
        evidence_gap: its -2 log evidence minus that of the term.
        candidate: the rival.
        misfit_gap: its misfit (chi-square and penalty) minus that of the term, without the cost of its parameters.
    """

    evidence_gap: float
    candidate: Candidate
    misfit_gap: float


RivalFits = tuple[RivalFit, ...]


@dataclass(frozen=True)
class ExchangeResult:
    """A fit in which no exchange of a term lowers -2 log evidence.

    Attributes:
        fit: the fit.
        rivals: by the key of each term, the other terms that were fitted instead of it.
    """

    fit: Fit
    rivals: dict[str, RivalFits]


def fit_exchanges(
    likelihood: Likelihood, fit: Fit, removed: Sequence[Candidate], pool: Sequence[Candidate], pairs: bool = False
) -> list[Fit]:
    """Fits in which one term of ``pool``, or with ``pairs`` also two, replace ``removed``; the best first."""
    present = {candidate.key for candidate in fit.model.candidates}
    new = [candidate for candidate in pool if candidate.key not in present]
    scores = [s for s in score_candidates(likelihood, fit, new, removed=removed) if np.any(s.columns)]
    if not scores:
        return []
    ends = np.cumsum([0, *(score.columns.shape[1] for score in scores)])
    columns = np.column_stack([score.columns[fit.rows] for score in scores])
    normal, gradient, _ = ProfiledLinearModel(fit, fit.rows, removed).normal_equations(columns)

    def predict_gain(group: tuple[int, ...]) -> tuple[float, Array]:
        indices = np.concatenate([np.arange(ends[i], ends[i + 1]) for i in group])
        gain, estimate = linear_gain(normal[np.ix_(indices, indices)], gradient[indices])
        return gain, np.clip(estimate, -MAX_PRIOR_SIGMAS, MAX_PRIOR_SIGMAS)

    starts = []
    for size in (1, 2) if pairs else (1,):
        groups = [(*predict_gain(group), group) for group in combinations(range(len(scores)), size)]
        groups.sort(key=lambda entry: -entry[0])
        for rank, (_, estimate, group) in enumerate(groups):
            confounds = size == 1 and any(_are_confounders(scores[group[0]].candidate, term) for term in removed)
            if rank < MAX_EXCHANGE_FITS or confounds:
                starts.append(_exchange_start(fit, removed, [scores[i] for i in group], estimate))
    fits = fit_models(
        likelihood,
        starts,
        max_iterations=PAIR_ITERATIONS if pairs else EXCHANGE_ITERATIONS,
        abort_above=fit.neg2_log_evidence + ABORT_MARGIN,
    )
    return sorted((f for f in fits if satisfies_sign_constraints(f)), key=lambda f: f.neg2_log_evidence)


def _are_confounders(new: Candidate, removed: Candidate) -> bool:
    """Whether a term is a known confounder of another, or of the same stage as a discrepancy term.

    Such terms are always fitted, because a first-order score is not reliable if the effect is large.
    """
    if removed.term.effect in DISCREPANCY_TERMS:
        return new.term.stage == removed.term.stage
    return removed.term.effect in new.term.confounders or new.term.effect in removed.term.confounders


def _exchange_start(
    fit: Fit, removed: Sequence[Candidate], new: Sequence[ScoreTest], estimate: Array
) -> tuple[Model, Array]:
    """The model in which ``new`` replaces ``removed``, and the start of its fit.

    All other parameters start at their fitted values: the removed effect is large, so a first-order prediction of their
    changes would not hold.
    """
    remaining = [candidate for candidate in fit.model.candidates if candidate not in removed]
    model = Model(fit.model.runs, fit.model.device, [*remaining, *(score.candidate for score in new)], fit.model.mains)
    x = model.map_parameters_from(fit.model, fit.x)
    first = 0
    for score in new:
        key = score.candidate.key
        indices = [i for i, f in enumerate(model.parameters) if f.kind == "term" and f.owner == key]
        x[indices] = [score.x[score.model.index("term", key, model.parameters[i].name)] for i in indices]
        width = score.columns.shape[1]
        if amplitude_indices(model, score.candidate):
            set_amplitudes(x, model, score.candidate, estimate[first : first + width])
        first += width
    return model, x


def rivals_of(fit: Fit, fits: Sequence[Fit]) -> RivalFits:
    """The last term of each of ``fits`` as a rival in ``fit``, with its differences of evidence and misfit."""
    misfit = fit.chi2 + fit.penalty
    return tuple(
        RivalFit(
            rival.neg2_log_evidence - fit.neg2_log_evidence,
            rival.model.candidates[-1],
            rival.chi2 + rival.penalty - misfit,
        )
        for rival in fits
    )


def exchange_to_convergence(likelihood: Likelihood, fit: Fit, pool: Sequence[Candidate], newest: int) -> ExchangeResult:
    """Exchange each of the ``newest`` last terms for a better one until no exchange lowers -2 log evidence."""
    rivals: dict[str, RivalFits] = {}
    for _ in range(MAX_EXCHANGES):
        rivals = {}
        exchanged = None
        for candidate in fit.model.candidates[len(fit.model.candidates) - newest :]:
            exchanges = fit_exchanges(likelihood, fit, (candidate,), pool)
            if exchanges and exchanges[0].neg2_log_evidence < fit.neg2_log_evidence - MIN_EXCHANGE_GAIN:
                exchanged = exchanges[0]
                break
            rivals[candidate.key] = rivals_of(fit, exchanges)
        if exchanged is None:
            break
        fit = exchanged
    return ExchangeResult(fit, rivals)
