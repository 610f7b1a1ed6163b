"""What each effect of a diagnosis contributes: fits with none, one, two, ... of the effects that were found."""

from __future__ import annotations

from estimation.diagnosis.diagnose import Diagnosis
from estimation.diagnosis.fit import Fit
from estimation.diagnosis.selection import refit_without


def nested_fits(found: Diagnosis) -> dict[str, Fit]:
    """Fits from the nominal device to the complete one, by the effect that each adds, largest contribution first."""
    assert found.search is not None
    rounds = sorted(found.search.steps, key=lambda each: each.after.neg2_log_evidence - each.before.neg2_log_evidence)
    fits = [found.search.final]
    for each in reversed(rounds):
        fits.append(refit_without(found.search.likelihood, fits[-1], each.candidate))
    names = ["linear", *(each.candidate.term.effect for each in rounds)]
    return dict(zip(names, reversed(fits), strict=True))


def findings_text(found: Diagnosis) -> str:
    """The findings, one line each."""
    lines = []
    for finding in found.findings:
        values = ", ".join(
            f"{p.name} = {p.value:.5g} [{p.ci95[0]:.5g}, {p.ci95[1]:.5g}] {p.unit}" for p in finding.parameters
        )
        law = values or (finding.curve or {}).get("formula", "")
        lines.append(f"  {finding.stage}: {finding.effect} (probability {finding.probability:.3f}): {law}")
    return "\n".join([*lines, f"  unexplained: {found.unexplained or 'nothing'}"])
