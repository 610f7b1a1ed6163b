"""What each term of a diagnosis is worth: devices from the nominal one, at its best, to the one with all of them."""

from __future__ import annotations

from estimation.mismatch.diagnosis import Diagnosis
from estimation.mismatch.fit import Fit
from estimation.mismatch.search import without


def ladder(found: Diagnosis) -> dict[str, Fit]:
    """Fits from the linear device to the whole one, by the term that each adds, heaviest first."""
    assert found.search is not None
    rounds = sorted(found.search.rounds, key=lambda each: each.after.evidence - each.before.evidence)
    fits = [found.search.final]
    for each in reversed(rounds):
        fits.append(without(found.search.comparison, fits[-1], each.candidate))
    names = ["linear", *(each.candidate.term.effect for each in rounds)]
    return dict(zip(names, reversed(fits), strict=True))


def told(found: Diagnosis) -> str:
    """The findings, a line each."""
    lines = []
    for finding in found.findings:
        values = ", ".join(
            f"{p.name} = {p.value:.5g} [{p.ci95[0]:.5g}, {p.ci95[1]:.5g}] {p.unit}" for p in finding.parameters
        )
        law = values or (finding.curve or {}).get("formula", "")
        lines.append(f"  {finding.stage}: {finding.effect} (probability {finding.probability:.3f}): {law}")
    return "\n".join([*lines, f"  unexplained: {found.unexplained or 'nothing'}"])
