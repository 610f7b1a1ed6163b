"""Whether corrections of other stages together explain what the correction of one stage explains."""

from __future__ import annotations

from collections.abc import Sequence

from estimation.candidate_terms.linear_model import RivalFit
from estimation.candidate_terms.linearisation import linear_model
from estimation.device_fit.fit import Fit, Likelihood
from estimation.device_fit.parameters import Candidate


def find_rival_stages(likelihood: Likelihood, fit: Fit, discrepancies: Sequence[Candidate]) -> tuple[RivalFit, ...]:
    """The corrections of all other stages together, in the linear model around a fit; empty if there are none.

    The rival stands for them all. Its candidate is the one without which they would be worst.

    Args:
        likelihood: of the fit.
        fit: whose last candidate is the correction of the found stage.
        discrepancies: the corrections of all stages.
    """
    linear, found = linear_model(likelihood, fit, discrepancies), fit.model.candidates[-1]
    candidates = [term.candidate for term in linear.discrepancies]
    own = [i for i, one in enumerate(candidates) if (one.axis, one.term.stage) == (found.axis, found.term.stage)]
    others = [i for i in range(len(candidates)) if i not in own]
    if not others:
        return ()
    alone, together = linear.hypothesis((), without=others), linear.hypothesis((), without=own)
    needed = max(others, key=lambda i: linear.hypothesis((), without=[*own, i]).neg2_log_evidence)
    gap = together.neg2_log_evidence - alone.neg2_log_evidence
    return (RivalFit(gap, candidates[needed], together.misfit - alone.misfit),)
