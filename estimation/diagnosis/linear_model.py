"""Linear model of a misfit: named laws beside a small discrepancy, compared by evidence.

Around a fit that has the phase of the motion right, every named law and every discrepancy term is linear. All
hypotheses contain the discrepancy terms of all stages, each with one scale that is estimated by maximum evidence, and
differ in the named laws beside them. A named law is favoured because the discrepancy that is left to explain is
smaller: every coefficient of it gains the logarithm of the ratio of the scales. All of it works on one triangular
factor of the sensitivities; inner products would square their condition number, and rounding would decide.

Source: model discrepancy, Kennedy & O'Hagan, J. R. Stat. Soc. B 63, 425 (2001); scales by MacKay's fixed point, Neural
Computation 4, 415 (1992).
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from estimation.diagnosis.discrepancy import DISCREPANCY_TERMS
from estimation.diagnosis.exchange import MIN_EXCHANGE_GAIN, RivalFit
from estimation.diagnosis.fit import Fit, Likelihood
from estimation.diagnosis.model import uncertain
from estimation.diagnosis.parameters import Candidate
from estimation.diagnosis.screening import (
    ScoreTest,
    is_amplitude,
    is_linear,
    score_candidate_starts,
)
from estimation.least_squares import regress, triangular_factor
from scanner.arrays import Array

SCALE_ITERATIONS = 12
"""Fixed-point iterations of the discrepancy's scales. They change a score by less than 1 afterwards."""

MIN_SCALE, MAX_SCALE, INITIAL_SCALE = 1e-4, 1.0, 0.1
"""Bounds of a discrepancy's scale in units of its prior, and the first value."""

SCREENING_FACTORS = (1.0, 0.1, 0.01)
"""Factors on the scales with which laws are ranked: beside a law that takes the bulk, the discrepancy is smaller."""

SCREENED_LAWS = 4
"""Laws whose score is computed with scales of their own, of every ranking."""

MIN_SCORE_GAIN = 10.0
"""Fall of -2 log evidence from which a law is added: 150 in probability, which leaves a margin for the choice among
the catalogue."""

MAX_SCALE_BESIDE = 0.1
"""Largest scale of a discrepancy beside which laws are selected, in units of its prior: a tenth of a discrepancy that
explains a misfit by itself."""

MAX_LAWS = 3
"""Laws that are selected together."""

MAX_STARTS = 3
"""Values of a law's time constant or frequency that stand for it in the linear model."""


@dataclass(frozen=True)
class LinearTerm:
    """A term as the linear model has it.

    Attributes:
        candidate: the term.
        columns: of the triangular factor, shape (q,).
        test: where it is linearised, None if the fit contains it.
        cost: -2 log of the share of its time constants and frequencies that the recording leaves possible.
    """

    candidate: Candidate
    columns: NDArray[np.intp]
    test: ScoreTest | None
    cost: float = 0.0


@dataclass(frozen=True)
class Hypothesis:
    """Named laws beside the discrepancy.

    Attributes:
        laws: indices of the laws.
        scales: variance of every discrepancy term's coefficients.
        neg2_log_evidence: lower is better.
        misfit: part of it that is not the cost of parameters.
    """

    laws: tuple[int, ...]
    scales: Array
    neg2_log_evidence: float
    misfit: float


def _score(hypothesis: Hypothesis) -> float:
    return hypothesis.neg2_log_evidence + MIN_SCORE_GAIN * len(hypothesis.laws)


@dataclass(frozen=True)
class LinearModel:
    """A misfit, named laws and discrepancies, compressed by an orthogonal factorisation.

    Attributes:
        factor: upper triangular, of all columns and, last, of the misfit without any of them, shape (q + 1, q + 1).
            Its columns have the inner products of the sensitivities, from which what every hypothesis contains is
            projected out.
        profile: what every hypothesis contains, as it follows the columns and the misfit: minus its estimate beside
            each, shape (p, q + 1).
        laws: named laws.
        discrepancies: discrepancy terms of all stages.
    """

    factor: Array
    profile: Array
    laws: tuple[LinearTerm, ...]
    discrepancies: tuple[LinearTerm, ...]

    @property
    def _groups(self) -> list[NDArray[np.intp]]:
        return [term.columns for term in self.discrepancies]

    def hypothesis(self, laws: Sequence[int], scales: Array | None = None, iterations: int = SCALE_ITERATIONS,
                   without: Collection[int] = (), max_scale: float = MAX_SCALE) -> Hypothesis:  # fmt: skip
        """The laws beside the discrepancy, its scales by maximum evidence from ``scales`` on.

        Args:
            without: discrepancy terms that are left out.
            max_scale: upper bound of the scales.
        """
        groups = [group for i, group in enumerate(self._groups) if i not in without]
        of_laws = [column for i in laws for column in self.laws[i].columns]
        at = np.concatenate([np.array(of_laws, int), *groups])
        ends = len(of_laws) + np.cumsum([0, *(group.size for group in groups)])
        reduced = triangular_factor(self.factor[:, [*at, -1]])
        start = np.full(len(self._groups), INITIAL_SCALE**2) if scales is None else scales
        values = np.array([v for i, v in enumerate(start) if i not in without])
        for turn in range(iterations + 1):
            precision = np.ones(at.size)
            for value, (low, high) in zip(values, pairwise(ends), strict=True):
                precision[low:high] = 1.0 / value
            regression = regress(reduced[:, :-1], reduced[:, -1:], precision)
            inverse = np.linalg.inv(regression.factor)
            estimate = -inverse @ regression.projected[:, 0]
            if turn == iterations:
                break
            variance = np.einsum("ij,ij->i", inverse, inverse)
            new = values.copy()
            for i, (low, high) in enumerate(pairwise(ends)):
                determined = (high - low) - float(variance[low:high].sum()) / values[i]
                new[i] = float(estimate[low:high] @ estimate[low:high]) / max(determined, 1e-3)
            values = np.clip(new, MIN_SCALE**2, max_scale**2)
        misfit = float(np.sum(regression.remainder**2))
        shapes = sum(self.laws[i].cost for i in laws)
        cost = regression.log_determinant - float(np.log(precision).sum())
        all_scales = np.array(start, float)
        all_scales[[i for i in range(len(self._groups)) if i not in without]] = values
        return Hypothesis(tuple(laws), all_scales, misfit + cost + shapes, misfit)

    def select(self) -> Hypothesis:
        """The laws beside a small discrepancy that no addition, removal or exchange improves.

        Each has to gain ``MIN_SCORE_GAIN``.
        """
        best = self.hypothesis((), max_scale=MAX_SCALE_BESIDE)
        while True:
            better = min(self._moves(best), key=_score, default=best)
            if _score(better) > _score(best) - MIN_EXCHANGE_GAIN:
                return best
            best = better

    def _moves(self, best: Hypothesis) -> Iterator[Hypothesis]:
        if len(best.laws) < MAX_LAWS:
            yield from self.beside(best.laws, best.scales)
        for i in best.laws:
            rest = tuple(law for law in best.laws if law != i)
            yield self.hypothesis(rest, best.scales, max_scale=MAX_SCALE_BESIDE)
            yield from self.beside(rest, best.scales)

    def beside(self, laws: tuple[int, ...], scales: Array) -> list[Hypothesis]:
        """The laws with one more, for the most promising of all others."""
        taken = {self.laws[i].candidate.term.effect for i in laws}
        others = [i for i, law in enumerate(self.laws) if law.candidate.term.effect not in taken]
        chosen: set[int] = set()
        for factor in SCREENING_FACTORS:
            gains = self._gains(laws, np.maximum(scales * factor**2, MIN_SCALE**2), others)
            chosen |= {others[i] for i in np.argsort(-gains)[:SCREENED_LAWS]}
        return [self.hypothesis((*laws, i), scales, max_scale=MAX_SCALE_BESIDE) for i in sorted(chosen)]

    def _gains(self, laws: Sequence[int], scales: Array, others: Sequence[int]) -> Array:
        """Fall of -2 log evidence by each of ``others`` beside ``laws``, at fixed scales."""
        of_laws = [column for i in laws for column in self.laws[i].columns]
        at = np.concatenate([np.array(of_laws, int), *self._groups])
        precision = np.concatenate(
            [np.ones(len(of_laws)), *(np.full(g.size, 1.0 / v) for g, v in zip(self._groups, scales, strict=True))]
        )
        new = [c for i in others for c in self.laws[i].columns]
        left = regress(self.factor[:, at], self.factor[:, [*new, -1]], precision).remainder
        gains, first = [], 0
        for i in others:
            last = first + len(self.laws[i].columns)
            regression = regress(left[:, first:last], left[:, -1:], np.ones(last - first))
            gain = float(np.sum(regression.projected**2)) - regression.log_determinant
            gains.append(gain - self.laws[i].cost)
            first = last
        return np.array(gains)

    def estimate(self, laws: Sequence[int]) -> tuple[Array, Array]:
        """Estimates of laws without a discrepancy, and of what every hypothesis contains beside them, shape (p,).

        The estimates of the laws follow each other in the order of ``laws``.
        """
        at = np.array([column for i in laws for column in self.laws[i].columns], int)
        regression = regress(self.factor[:, at], self.factor[:, -1:], np.ones(at.size))
        of_laws = np.asarray(-np.linalg.solve(regression.factor, regression.projected[:, 0]))
        return of_laws, -(self.profile[:, at] @ of_laws + self.profile[:, -1])

    def effects(self, laws: Iterable[int]) -> set[str]:
        """Names of laws."""
        return {self.laws[i].candidate.term.effect for i in laws}

    def rivals(self, hypothesis: Hypothesis, law: int) -> tuple[RivalFit, ...]:
        """Other laws in the place of one, the best of each first.

        A rival that seems better is one whose evidence rounding spoils, because an exchange has been tried.
        """
        rest = tuple(i for i in hypothesis.laws if i != law)
        best: dict[str, RivalFit] = {}
        for rival in sorted(self.beside(rest, hypothesis.scales), key=lambda other: other.neg2_log_evidence):
            candidate = self.laws[rival.laws[-1]].candidate
            gap = rival.neg2_log_evidence - hypothesis.neg2_log_evidence
            if candidate.term.effect != self.laws[law].candidate.term.effect and gap > -MIN_EXCHANGE_GAIN:
                best.setdefault(candidate.key, RivalFit(gap, candidate, rival.misfit - hypothesis.misfit))
        return tuple(best.values())

    def are_needed(self, laws: Sequence[int], imitation_margin: float, margin: float) -> bool:
        """Whether a discrepancy without bound on its scales needs laws beside it.

        Args:
            imitation_margin: advantage in -2 log evidence that laws need over a discrepancy alone that fits better.
            margin: advantage that they need in any case.
        """
        alone, beside = self.hypothesis(()), self.hypothesis(laws)
        fits_better = alone.misfit < beside.misfit - MIN_SCORE_GAIN
        advantage = alone.neg2_log_evidence - beside.neg2_log_evidence
        return advantage > (imitation_margin if fits_better else margin)

    def gain_of_discrepancy(self, laws: Sequence[int], stage: str | None = None) -> float:
        """Fall of the misfit by the discrepancy terms of one stage, or of all, beside laws and all other terms."""
        dropped = [i for i, term in enumerate(self.discrepancies) if stage in (None, term.candidate.term.stage)]
        return max(self.hypothesis(laws, without=dropped).misfit - self.hypothesis(laws).misfit, 0.0)


def linear_model(likelihood: Likelihood, fit: Fit, candidates: Sequence[Candidate]) -> LinearModel:
    """The linear model around a fit, of its own terms and of ``candidates``."""
    rows, base = fit.rows, common_parameters(fit)
    residual = fit.residual - fit.jacobian[:, base] @ fit.x[base]
    blocks: list[tuple[Candidate, Array, ScoreTest | None, float]] = []
    for candidate in uncertain(fit.model):
        columns, part = _part_of_fit(fit, candidate)
        residual = residual - part
        blocks.append((candidate, columns, None, _shape_cost(fit, candidate)))
    present = {candidate.key for candidate in fit.model.candidates}
    others = [candidate for candidate in candidates if candidate.key not in present and is_linear(candidate)]
    for tests in score_candidate_starts(likelihood, fit, others):
        cost = 2.0 * float(np.log(len(tests)))
        blocks += [(test.candidate, test.columns, test, cost) for test in _linear_starts(tests)]
    whole = np.column_stack([*(columns[rows] for _, columns, *_ in blocks), residual[rows]])
    common = regress(fit.jacobian[rows][:, base], whole, fit.model.precision[base])
    profile = np.asarray(np.linalg.solve(common.factor, common.projected))
    ends = np.cumsum([0, *(columns.shape[1] for _, columns, *_ in blocks)])
    terms = [
        LinearTerm(candidate, np.arange(low, high), test, cost)
        for (candidate, _, test, cost), (low, high) in zip(blocks, pairwise(ends), strict=True)
    ]
    discrepancies = tuple(term for term in terms if term.candidate.term.effect in DISCREPANCY_TERMS)
    laws = tuple(term for term in terms if term.candidate.term.effect not in DISCREPANCY_TERMS)
    return LinearModel(common.remainder, profile, laws, discrepancies)


def _linear_starts(tests: Sequence[ScoreTest]) -> list[ScoreTest]:
    """The best starts of one candidate, where it has an effect."""
    with_effect = [test for test in tests if np.any(test.columns)]
    most = 1 if tests[0].candidate.term.effect in DISCREPANCY_TERMS else MAX_STARTS
    return sorted(with_effect, key=lambda test: -test.predicted_gain)[:most]


def _part_of_fit(fit: Fit, candidate: Candidate) -> tuple[Array, Array]:
    """Sensitivities to the amplitudes of a term of a fit, shape (N, q), and its part of the residual, shape (N,)."""
    at = [
        i
        for i, f in enumerate(fit.model.parameters)
        if f.owner == candidate.key and f.parameter is not None and is_amplitude(candidate, f.parameter)
    ]
    return fit.jacobian[:, at], fit.jacobian[:, at] @ fit.x[at]


def _shape_cost(fit: Fit, candidate: Candidate) -> float:
    """-2 log of posterior over prior volume of the parameters of a term that are no amplitude."""
    at = [
        i
        for i, f in enumerate(fit.model.parameters)
        if f.owner == candidate.key and f.parameter is not None and not is_amplitude(candidate, f.parameter)
    ]
    return -float(np.linalg.slogdet(fit.covariance[np.ix_(at, at)])[1]) if at else 0.0


def common_parameters(fit: Fit) -> list[int]:
    """Indices of the parameters of a fit that belong to no term."""
    return [i for i, f in enumerate(fit.model.parameters) if f.kind not in ("term", "hidden")]
