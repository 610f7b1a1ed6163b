"""The law of what the findings of a diagnosis leave, measured beside them and added to the improved device."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from estimation.candidate_terms.curves import CURVE_TERMS
from estimation.candidate_terms.discrepancy import DISCREPANCY_TERMS, is_discrepancy
from estimation.candidate_terms.linearisation import fit_terms, linear_model
from estimation.candidate_terms.significance import evidence_gain
from estimation.device_fit.fit import Fit, fit_model
from estimation.device_fit.model import Model
from estimation.device_fit.open_loop import is_worse, open_loop
from estimation.device_fit.parameters import Candidate
from estimation.diagnosis.discrepancy_law import STATIC_PARAMETERS
from estimation.diagnosis.discrepancy_selection import with_refined_curve
from estimation.diagnosis.improvement import Improvement, improved_device, predicts_no_worse
from estimation.diagnosis.pruning import prune_by_evidence, with_free_parameters
from scanner.terms.measured_law import EFFECT as MEASURED_LAW

STATIC_LAWS = {
    "free-mechanics": DISCREPANCY_TERMS["free-mechanics"],
    "free-readout": CURVE_TERMS["free-readout-curve"],
    "free-drive": CURVE_TERMS["free-drive-curve"],
}
"""For corrections with a part that a device file can state, the term that describes this part best."""


def with_remainder_law(improvement: Improvement, correction: Candidate) -> Improvement:
    """Add to the improved device the law of what its named laws leave, if its prediction is worse without it.

    It is worse if the errors of all channels together are larger beyond the uncertainty of the comparison; with the law
    no channel of any run may be predicted worse. A device file can state only the part of a law that depends on the
    present state. What depends on time or on previous states stays a remainder.

    Args:
        correction: free correction that would explain most of what the findings leave.
    """
    device, final = improvement.device, improvement.search.final
    static = STATIC_LAWS.get(correction.term.effect)
    named = bool(final.model.candidates) and not any(map(is_discrepancy, final.model.candidates))
    if static is None or not named or device is final.model.device:
        return improvement
    if MEASURED_LAW in device.axis(correction.axis).terms:
        return improvement
    law = with_free_parameters(Candidate(static, correction.axis, correction.channel), STATIC_PARAMETERS[static.effect])
    fit = _fit_beside(improvement, law)
    if fit is None:
        return improvement
    extended, runs = improved_device(fit), improvement.search.likelihood.runs
    loops = open_loop(runs, extended)
    if not is_worse(loops, improvement.improved) or not all(predicts_no_worse(run, device, extended) for run in runs):
        return improvement
    return replace(improvement, device=extended, improved=loops, remainder_fit=fit)


def _fit_beside(improvement: Improvement, law: Candidate) -> Fit | None:
    """Fit of a law and the nominal values beside the named laws as they are; None if the recordings do not require it.

    Fitted together, both may describe the same torque, and the value of a named law would not be the one reported.
    """
    likelihood, final = improvement.search.likelihood, improvement.search.final
    model = Model(likelihood.runs, improvement.device, mains=final.model.mains)
    states = np.where([f.kind in ("nominal", "term") for f in final.model.parameters], 0.0, final.x)
    base = fit_model(likelihood, model, model.map_parameters_from(final.model, states))
    linear = linear_model(likelihood, base, [law])
    if not linear.discrepancies:
        return None
    fit = prune_by_evidence(likelihood, fit_terms(linear, likelihood, base, linear.discrepancies))
    if fit is None:
        return None
    fit = with_refined_curve(likelihood, fit)
    return fit if evidence_gain(likelihood, base, fit) else None
