"""Laws to be fitted in the place of selected ones, as sensitivities do not rank laws of similar effect well."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence

from estimation.candidate_terms.linear_model import Effects, Hypothesis, LinearModel
from estimation.candidate_terms.significance import DETECTION_THRESHOLD

MAX_ALTERNATIVES = 6
"""Laws that are fitted in the place of each other, the best in the linear model: single laws around a discrepancy, as
sensitivities do not rank them well, and near rivals of selected laws. Each costs a fit."""


def near_rivals(
    linear: LinearModel, hypothesis: Hypothesis, fitted: Collection[Effects]
) -> dict[Effects, tuple[int, ...]]:
    """Laws with one exchanged that are within ``DETECTION_THRESHOLD`` of a hypothesis and have not been fitted.

    The first are the best ones in the place of every law, then the second ones, up to ``MAX_ALTERNATIVES``.
    """
    ranked: list[tuple[int, float, tuple[int, ...]]] = []
    for removed in hypothesis.laws:
        rest = tuple(law for law in hypothesis.laws if law != removed)
        best: dict[Effects, Hypothesis] = {}
        for rival in sorted(linear.beside(rest, hypothesis.scales), key=lambda one: one.neg2_log_evidence):
            if rival.neg2_log_evidence < hypothesis.neg2_log_evidence + DETECTION_THRESHOLD:
                best.setdefault(linear.effects(rival.laws), rival)
        new = [rival for effects, rival in best.items() if effects not in fitted]
        ranked += [(rank, rival.neg2_log_evidence, rival.laws) for rank, rival in enumerate(new)]
    return {linear.effects(laws): laws for _, _, laws in sorted(ranked)[:MAX_ALTERNATIVES]}


def stated_confounders(
    linear: LinearModel, laws: Sequence[int], fitted: Collection[Effects]
) -> dict[Effects, tuple[int, ...]]:
    """Laws with one exchanged for a confounder on its axis that the term of either states and that has not been fitted.

    Around a law that stands for its confounder, as a damping that drifts for one that depends on the amplitude in a
    decay, the linear model does not show that the other explains more. They are up to ``MAX_ALTERNATIVES``, those
    first that explain most without a discrepancy.
    """
    sets = []
    for removed in laws:
        own, rest = linear.laws[removed].candidate, tuple(law for law in laws if law != removed)
        for i, law in enumerate(linear.laws):
            other, present = law.candidate, linear.effects([i]) & linear.effects(laws)
            is_stated = other.term.effect in own.term.confounders or own.term.effect in other.term.confounders
            if is_stated and other.axis == own.axis and not present:
                sets.append((*rest, i))
    return best_not_fitted(linear, sets, fitted)


def best_not_fitted(
    linear: LinearModel, sets: Iterable[tuple[int, ...]], fitted: Collection[Effects]
) -> dict[Effects, tuple[int, ...]]:
    """Sets of laws with the best evidence without a discrepancy, one for each effects that have not been fitted.

    They are up to ``MAX_ALTERNATIVES``, the best first.
    """
    best: dict[Effects, tuple[int, ...]] = {}
    for laws in sorted(sets, key=lambda one: linear.without_discrepancy(one).neg2_log_evidence):
        if (effects := linear.effects(laws)) not in fitted:
            best.setdefault(effects, laws)
    return dict(list(best.items())[:MAX_ALTERNATIVES])
