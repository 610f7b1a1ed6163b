"""Exchange of a discrepancy term for named terms."""

from __future__ import annotations

from collections.abc import Sequence

from estimation.diagnosis.discrepancy import DISCREPANCY_TERMS
from estimation.diagnosis.exchange import fit_exchanges
from estimation.diagnosis.fit import Fit, Likelihood, fit_model
from estimation.diagnosis.initial import estimate_whiteners
from estimation.diagnosis.model import Candidate
from estimation.diagnosis.significance import is_significant

MAX_DISCREPANCY_FITS = 3
"""Number of discrepancy terms that are pruned and compared with named terms. Each costs a fit."""


def replace_discrepancy_by_terms(
    likelihood: Likelihood, before: Fit, free: Fit, named: Sequence[Candidate]
) -> tuple[Likelihood, Fit, Fit]:
    """Replace a discrepancy term by named terms if they have the better evidence, under newly estimated noise.

    Returns:
        likelihood, the fit before, the fit with the terms or, where none is adequate, with the discrepancy term.
    """
    others = fit_exchanges(likelihood, free, free.model.candidates[-1:], named, pairs=True)
    others = [
        fit
        for fit in others
        if fit.neg2_log_evidence < free.neg2_log_evidence and is_significant(likelihood, before, fit)
    ]
    if not others:
        return likelihood, before, free
    named_fit = others[0]
    fewer = [fit for fit in others if len(fit.model.candidates) < len(named_fit.model.candidates)]
    # the second of two terms must be significant like any second effect
    if fewer and not is_significant(likelihood, fewer[0], named_fit):
        named_fit = fewer[0]
    likelihood = Likelihood(likelihood.runs, estimate_whiteners(named_fit.model, named_fit.x))
    before = fit_model(likelihood, before.model, before.x)
    return likelihood, before, fit_model(likelihood, named_fit.model, named_fit.x)


def ends_with_discrepancy(fit: Fit) -> bool:
    """Whether the term that a fit has last is a discrepancy term."""
    return bool(fit.model.candidates) and fit.model.candidates[-1].term.effect in DISCREPANCY_TERMS
