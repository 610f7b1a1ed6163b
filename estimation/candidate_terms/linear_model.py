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
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimation.candidate_terms.screening import ScoreTest, is_amplitude
from estimation.candidate_terms.significance import DETECTION_THRESHOLD
from estimation.device_fit.parameters import Candidate
from estimation.least_squares import regress, triangular_factor
from scanner.arrays import Array

Effects = frozenset[tuple[str, str]]
"""Effects of a set of laws: axis and name of each."""

SCALE_ITERATIONS, SCORE_TOLERANCE = 12, 0.05
"""Largest number of fixed-point iterations of the discrepancy's scales, and the change of a score by the next one below
which they end: half of the smallest difference on which a choice depends. The limits here and in ``necessity.py`` are
calibrated with this number; without laws a score would fall by up to 15 more."""

MIN_DETERMINED = 1e-3
"""Least number of coefficients of a discrepancy term that count as determined: it keeps a scale finite."""

MIN_SCALE, MAX_SCALE, INITIAL_SCALE = 1e-4, 1.0, 0.1
"""Bounds of a discrepancy's scale in units of its prior, and the first value."""

SCREENING_FACTORS = (1.0, 0.1, 0.01)
"""Factors on the scales with which laws are ranked: beside a law that takes the bulk, the discrepancy is smaller."""

SCREENING_SCALE = 0.01
"""Scale of the discrepancy of every stage with which laws are ranked once more. Where wrong laws leave only noise, all
scales vanish, and a ranking without a discrepancy demands more of sensitivities than they are accurate: a drag beside
two drifts, of which one was fitted beside a clock error, seemed 300 worse in -2 log evidence and was 30 better."""

SCREENED_LAWS = 4
"""Laws whose score is computed with scales of their own, of every ranking."""

MAX_SCALE_BESIDE = 0.1
"""Largest scale of a discrepancy beside which laws are selected, in units of its prior: a tenth of a discrepancy that
explains a misfit by itself."""

MIN_EXCHANGE_GAIN = 0.1
"""Decrease of -2 log evidence from which a law is exchanged: twice the tolerance of a fit."""

MAX_LAWS = 3
"""Laws that are selected together."""


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


def columns_of(terms: Iterable[LinearTerm]) -> NDArray[np.intp]:
    """Columns of the triangular factor of several terms, one after the other."""
    return np.array([column for term in terms for column in term.columns], np.intp)


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
        cost: -2 log of posterior over prior volume of what every hypothesis contains.
    """

    factor: Array
    profile: Array
    laws: tuple[LinearTerm, ...]
    discrepancies: tuple[LinearTerm, ...]
    cost: float = 0.0

    def hypothesis(self, laws: Sequence[int], scales: Array | None = None, without: Collection[int] = (),
                   max_scale: float = MAX_SCALE) -> Hypothesis:  # fmt: skip
        """The laws beside the discrepancy, its scales by maximum evidence from ``scales`` on.

        Args:
            without: discrepancy terms that are left out.
            max_scale: upper bound of the scales.
        """
        used = [i for i in range(len(self.discrepancies)) if i not in without]
        of_laws = columns_of(self.laws[i] for i in laws)
        sizes = np.array([self.discrepancies[i].columns.size for i in used], int)
        at = np.concatenate([of_laws, columns_of(self.discrepancies[i] for i in used)])
        ends = of_laws.size + np.cumsum([0, *sizes])
        reduced = triangular_factor(self.factor[:, [*at, -1]])
        start = np.full(len(self.discrepancies), INITIAL_SCALE**2) if scales is None else scales
        values = np.clip(start[used], MIN_SCALE**2, max_scale**2)
        for iteration in range(SCALE_ITERATIONS + 1):
            precision = np.concatenate([np.ones(of_laws.size), np.repeat(1.0 / values, sizes)])
            regression = regress(reduced[:, :-1], reduced[:, -1:], precision)
            inverse = regression.inverse_factor
            estimate = -inverse @ regression.projected[:, 0]
            variance = np.einsum("ij,ij->i", inverse, inverse)
            power = np.array([estimate[low:high] @ estimate[low:high] for low, high in pairwise(ends)])
            spread = np.array([variance[low:high].sum() for low, high in pairwise(ends)])
            determined = np.maximum(np.diff(ends) - spread / values, MIN_DETERMINED)
            new = np.clip(power / determined, MIN_SCALE**2, max_scale**2)
            slope = determined - power / values  # of the score by the logarithm of a scale
            change = float(np.abs(slope * np.log(new / values)).sum())
            if change < SCORE_TOLERANCE or iteration == SCALE_ITERATIONS:
                break
            values = new
        misfit = float(np.sum(regression.remainder**2))
        shapes = sum(self.laws[i].cost for i in laws)
        cost = regression.log_determinant - float(np.log(precision).sum())
        all_scales = start.copy()
        all_scales[used] = values
        return Hypothesis(tuple(laws), all_scales, misfit + cost + shapes + self.cost, misfit)

    def select(self, laws: Sequence[int] = (), max_moves: float = np.inf, kept: Collection[int] = ()) -> Hypothesis:
        """The laws beside a small discrepancy after the moves that improve them most: additions, removals, exchanges.

        Each law has to gain ``DETECTION_THRESHOLD``, and a second or third law more than the discrepancy beside them
        still gains: a law that gains less imitates what no law describes.

        Args:
            laws: to start from.
            max_moves: largest number of moves.
            kept: laws that no move removes.
        """
        needed = self._without_imitations(tuple(laws), kept)
        best = self.hypothesis(needed, max_scale=MAX_SCALE_BESIDE)
        if needed != tuple(laws):
            max_moves -= 1
        while max_moves > 0:
            limit = self._score(best) - MIN_EXCHANGE_GAIN
            moves = sorted((move for move in self._moves(best, kept) if self._score(move) < limit), key=self._score)
            better = next((move for move in moves if self._is_possible(move.laws, kept)), None)
            if better is None:
                break
            best, max_moves = better, max_moves - 1
        return best

    def _score(self, hypothesis: Hypothesis) -> float:
        """-2 log evidence with the price of each law, with the discrepancy or without any if that is better.

        A discrepancy alone has the price of one law.
        """
        laws = hypothesis.laws
        without = self.without_discrepancy(laws).neg2_log_evidence
        beside = hypothesis.neg2_log_evidence + (0.0 if laws else DETECTION_THRESHOLD)
        return min(without, beside) + DETECTION_THRESHOLD * len(laws)

    def _is_possible(self, laws: tuple[int, ...], kept: Collection[int] = ()) -> bool:
        """Whether all estimates have a physically possible sign, and no law that is not kept is an imitation."""
        estimates, first = self.estimate([self.laws[i] for i in laws]), 0
        for i in laws:
            candidate = self.laws[i].candidate
            signs = [p.sign for p in candidate.term.free_parameters if is_amplitude(candidate, p)]
            if any(sign * estimates[first + j] < 0.0 for j, sign in enumerate(signs)):
                return False
            first += self.laws[i].columns.size
        return self._without_imitations(laws, kept) == laws

    def estimate(self, terms: Sequence[LinearTerm]) -> Array:
        """Estimates of terms without others, one after the other."""
        at = columns_of(terms)
        regression = regress(self.factor[:, at], self.factor[:, -1:], np.ones(at.size))
        return np.asarray(-np.linalg.solve(regression.factor, regression.projected[:, 0]))

    def _without_imitations(self, laws: tuple[int, ...], kept: Collection[int] = ()) -> tuple[int, ...]:
        """Several laws without those that gain less than the discrepancy beside all of them, the least first."""
        while len(laws) > 1 and not set(laws) <= set(kept):
            rests = [tuple(law for law in laws if law != removed) for removed in laws if removed not in kept]
            closest = min(rests, key=self._misfit)
            if self._misfit(closest) - self._misfit(laws) > self.gain_of_discrepancy(laws):
                break
            laws = closest
        return laws

    def without_discrepancy(self, laws: Sequence[int]) -> Hypothesis:
        """The laws without a discrepancy."""
        return self.hypothesis(laws, without=range(len(self.discrepancies)))

    def _misfit(self, laws: Sequence[int]) -> float:
        """Of laws without a discrepancy."""
        return self.without_discrepancy(laws).misfit

    def _moves(self, best: Hypothesis, kept: Collection[int]) -> Iterator[Hypothesis]:
        if len(best.laws) < MAX_LAWS:
            yield from self.beside(best.laws, best.scales)
        for i in (law for law in best.laws if law not in kept):
            rest = tuple(law for law in best.laws if law != i)
            yield self.hypothesis(rest, best.scales, max_scale=MAX_SCALE_BESIDE)
            yield from self.beside(rest, best.scales)

    def beside(self, laws: tuple[int, ...], scales: Array) -> list[Hypothesis]:
        """The laws with one more, for the most promising of all others."""
        taken = self.effects(laws)
        others = [i for i in range(len(self.laws)) if not self.effects([i]) & taken]
        chosen: set[int] = set()
        rankings = [np.maximum(scales * factor**2, MIN_SCALE**2) for factor in SCREENING_FACTORS]
        for of_ranking in [*rankings, np.full_like(scales, SCREENING_SCALE**2)]:
            gains = self._gains(laws, of_ranking, others)
            chosen |= {others[i] for i in np.argsort(-gains)[:SCREENED_LAWS]}
        return [self.hypothesis((*laws, i), scales, max_scale=MAX_SCALE_BESIDE) for i in sorted(chosen)]

    def _gains(self, laws: Sequence[int], scales: Array, others: Sequence[int]) -> Array:
        """Fall of -2 log evidence by each of ``others`` beside ``laws``, at fixed scales."""
        of_laws = columns_of(self.laws[i] for i in laws)
        at = np.concatenate([of_laws, columns_of(self.discrepancies)])
        sizes = np.array([term.columns.size for term in self.discrepancies], int)
        precision = np.concatenate([np.ones(of_laws.size), np.repeat(1.0 / scales, sizes)])
        new = columns_of(self.laws[i] for i in others)
        left = regress(self.factor[:, at], self.factor[:, [*new, -1]], precision).remainder
        gains, first = [], 0
        for i in others:
            last = first + self.laws[i].columns.size
            regression = regress(left[:, first:last], left[:, -1:], np.ones(last - first))
            gain = float(np.sum(regression.projected**2)) - regression.log_determinant
            gains.append(gain - self.laws[i].cost)
            first = last
        return np.array(gains)

    def strongest_together(self) -> tuple[int, ...]:
        """Laws without a discrepancy, each the one that improves the evidence most beside those before it.

        They take the bulk of a misfit where the sensitivities are too inaccurate for the small discrepancy beside the
        right laws, so that :meth:`select` prefers a law that leaves everything to a discrepancy.
        """
        laws: tuple[int, ...] = ()
        lowest = self.without_discrepancy(laws).neg2_log_evidence
        while len(laws) < MAX_LAWS:
            taken = self.effects(laws)
            more = [(*laws, i) for i in range(len(self.laws)) if not self.effects([i]) & taken]
            limit = lowest - DETECTION_THRESHOLD
            improved = {m: e for m in more if (e := self.without_discrepancy(m).neg2_log_evidence) < limit}
            best = next((m for m in sorted(improved, key=improved.__getitem__) if self._is_possible(m)), None)
            if best is None:
                break
            laws, lowest = best, improved[best]
        return laws

    def strongest(self, number: int) -> list[tuple[int, ...]]:
        """The single laws of different effects with the best evidence beside a small discrepancy."""
        singles = [self.hypothesis((i,), max_scale=MAX_SCALE_BESIDE) for i in range(len(self.laws))]
        best: dict[Effects, tuple[int, ...]] = {}
        for single in sorted(singles, key=lambda hypothesis: hypothesis.neg2_log_evidence):
            best.setdefault(self.effects(single.laws), single.laws)
        return list(best.values())[:number]

    def describe(self, laws: Iterable[int]) -> str:
        """Names of laws with their axes as text."""
        return ", ".join(f"{axis} {effect}" for axis, effect in sorted(self.effects(laws))) or "no named law"

    def effects(self, laws: Iterable[int]) -> Effects:
        """Axis and name of laws."""
        candidates = (self.laws[i].candidate for i in laws)
        return frozenset((candidate.axis, candidate.term.effect) for candidate in candidates)

    def rivals(self, hypothesis: Hypothesis, law: int) -> tuple[RivalFit, ...]:
        """Other laws in the place of one, the best of each first.

        A rival that seems better is one whose evidence rounding spoils, because an exchange has been tried.
        """
        rest = tuple(i for i in hypothesis.laws if i != law)
        best: dict[str, RivalFit] = {}
        for rival in sorted(self.beside(rest, hypothesis.scales), key=lambda other: other.neg2_log_evidence):
            candidate = self.laws[rival.laws[-1]].candidate
            gap = rival.neg2_log_evidence - hypothesis.neg2_log_evidence
            if self.effects(rival.laws[-1:]) != self.effects([law]) and gap > -MIN_EXCHANGE_GAIN:
                best.setdefault(candidate.key, RivalFit(gap, candidate, rival.misfit - hypothesis.misfit))
        return tuple(best.values())

    def gain_of_discrepancy(self, laws: Sequence[int]) -> float:
        """Fall of the misfit by the discrepancy terms of all stages beside laws."""
        return max(self._misfit(laws) - self.hypothesis(laws).misfit, 0.0)
