"""Contribution of each effect of a diagnosis: fits with none, one, two, ... of its effects."""

from __future__ import annotations

from estimation.device_fit.fit import Fit
from estimation.diagnosis.diagnose import Diagnosis
from estimation.diagnosis.pruning import refit_without


def nested_fits(diagnosis: Diagnosis) -> dict[str, Fit]:
    """Fits from the nominal device to the complete one, by the effect that each adds, largest contribution first."""
    assert diagnosis.search is not None
    steps = sorted(
        diagnosis.search.steps, key=lambda step: step.after.neg2_log_evidence - step.before.neg2_log_evidence
    )
    fits = [diagnosis.search.final]
    for step in reversed(steps):
        fits.append(refit_without(diagnosis.search.likelihood, fits[-1], step.candidate))
    names = ["linear", *(step.candidate.term.effect for step in steps)]
    return dict(zip(names, reversed(fits), strict=True))


def findings_text(diagnosis: Diagnosis) -> str:
    """The findings, one line each."""
    lines = []
    for finding in diagnosis.findings:
        values = ", ".join(
            f"{p.name} = {p.value:.5g} [{p.ci95[0]:.5g}, {p.ci95[1]:.5g}] {p.unit}" for p in finding.parameters
        )
        law = values or (finding.curve or {}).get("formula", "")
        lines.append(f"  {finding.stage}: {finding.effect} (probability {finding.probability:.3f}): {law}")
    return "\n".join([*lines, f"  unexplained: {diagnosis.unexplained or 'nothing'}"])
