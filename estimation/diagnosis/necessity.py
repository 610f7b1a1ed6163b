"""Whether named laws are the answer beside free corrections of every stage, which explain a misfit without them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from estimation.candidate_terms.linear_model import LinearModel
from estimation.candidate_terms.linearisation import linear_model
from estimation.candidate_terms.significance import DETECTION_THRESHOLD
from estimation.device_fit.fit import Fit, Likelihood
from estimation.device_fit.parameters import Candidate

MIN_EXPLAINED_RATIO = 0.1
"""Fall of the misfit by laws over that by free corrections beside them, from which laws may be the answer. Nominal
values absorb most of a drift, so that a small imperfection may be larger than what is left of the drift: a true one had
0.3. Laws that imitated an unlisted effect had 0.04 and less."""

MAX_REMAINDER_RATIO = 0.03
"""Fall of the misfit by free corrections beside laws, over that by the laws, up to which the laws take the bulk of it.
Gravity and friction of a measured pendulum leave 3 %, a cubic spring in the place of a stop on one side 4 %."""

POLYNOMIAL_SPRINGS = frozenset({"quadratic-stiffness", "cubic-stiffness", "quintic-stiffness"})
"""Powers of the angle, of which several together approximate any spring: they do not count as the bulk of a misfit."""

SMALL_LAW_MARGIN = 25.0
"""Least advantage in -2 log evidence over a discrepancy alone that laws need which leave more. A quintic spring that
imitates a delay with memory has 12, laws beside the imperfections of ``cases_imperfect`` have 62 and more."""

MIN_ADVANTAGE_RATIO = 0.01
"""Least advantage of such laws over the misfit that they leave to a discrepancy beside them. Scores are accurate to a
fraction of what is left, and every coefficient of a discrepancy adds to the advantage of laws that take only a part.
True laws had 0.026 and more, wrong ones 0.002 and less, with one exception: a spring in the place of a pivot that
slips, beside a clipped readout, had 0.05."""


class Need(NamedTuple):
    """Whether laws are the answer beside a discrepancy without bound on its scales.

    Attributes:
        possible: they may be, as a base beside which another law is sought.
        certain: and they are the answer if no other law is found.
        takes_bulk: whether they leave little to corrections; see ``MAX_REMAINDER_RATIO``.
        remaining: fall of -2 log evidence by free corrections of all stages beside them.
    """

    possible: bool
    certain: bool
    takes_bulk: bool
    remaining: float


NO_LAWS = Need(possible=False, certain=True, takes_bulk=False, remaining=0.0)
"""Of the nominal device and of a discrepancy term, beside which there are no laws."""


def least_explained(need: Need) -> float:
    """Fall of the misfit that a further law needs to be the answer beside laws that take the bulk; 0 beside others.

    It has to explain ``MIN_EXPLAINED_RATIO`` of what free corrections still explain beside it. That is at least what
    they explain without it, less what it explains itself.
    """
    return need.remaining * MIN_EXPLAINED_RATIO / (1.0 + MIN_EXPLAINED_RATIO) if need.takes_bulk else 0.0


def need_of_laws(linear: LinearModel, laws: Sequence[int], explained: float, alone: float) -> Need:
    """Whether a discrepancy without bound on its scales needs laws beside it.

    They have to explain ``MIN_EXPLAINED_RATIO`` of what the discrepancy beside them still does. Against laws that
    take the bulk of the misfit, the discrepancy alone has to gain as much as a law; others need an advantage in
    evidence of ``SMALL_LAW_MARGIN`` over it, and as the answer ``MIN_ADVANTAGE_RATIO`` of what they leave.

    Args:
        explained: fall of the misfit by the laws.
        alone: -2 log evidence of the discrepancy without them.
    """
    beside = linear.hypothesis(laws)
    without = linear.without_discrepancy(laws)
    remainder = without.misfit - beside.misfit
    remaining = without.neg2_log_evidence - beside.neg2_log_evidence
    advantage = alone - min(beside.neg2_log_evidence, without.neg2_log_evidence)
    springs = [axis for axis, effect in linear.effects(laws) if effect in POLYNOMIAL_SPRINGS]
    series = len(springs) > len(set(springs))
    takes_bulk = remaining <= DETECTION_THRESHOLD or (remainder < MAX_REMAINDER_RATIO * explained and not series)
    possible = explained >= MIN_EXPLAINED_RATIO * remainder and advantage > (
        -DETECTION_THRESHOLD if takes_bulk else SMALL_LAW_MARGIN
    )
    certain = possible and (takes_bulk or advantage > MIN_ADVANTAGE_RATIO * remainder)
    return Need(possible, certain, takes_bulk, remaining)


def need_beside(
    likelihood: Likelihood, base: Fit, with_laws: Fit, discrepancies: Sequence[Candidate], explained: float
) -> Need:
    """Whether free corrections beside a fit need the laws that it has beyond another one.

    Args:
        base, with_laws: fits under ``likelihood``.
        explained: fall of the misfit by these laws.
    """
    without, beside = (linear_model(likelihood, fit, discrepancies) for fit in (base, with_laws))
    alone = without.hypothesis(range(len(without.laws))).neg2_log_evidence
    return need_of_laws(beside, range(len(beside.laws)), explained, alone)
