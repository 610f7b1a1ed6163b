"""What each term of a diagnosis is worth: devices from the nominal one, at its best, to the one with all of them."""

from __future__ import annotations

from estimation.mismatch.diagnosis import Diagnosis
from estimation.mismatch.fit import Fit
from estimation.mismatch.search import without


def ladder(found: Diagnosis) -> dict[str, Fit]:
    """Fits from the linear device to the whole one, by the term that each adds, heaviest first."""
    fits = [found.search.final]
    for finding in reversed(found.findings):
        candidate = next(each for each in fits[-1].model.candidates if each.term.effect == finding.effect)
        fits.append(without(found.search.comparison, fits[-1], candidate))
    names = ["linear", *(finding.effect for finding in found.findings)]
    return dict(zip(names, reversed(fits), strict=True))


def told(found: Diagnosis) -> str:
    """The findings, a line each."""
    lines = []
    for finding in found.findings:
        values = ", ".join(
            f"{p.name} = {p.value:.5g} [{p.ci95[0]:.5g}, {p.ci95[1]:.5g}] {p.unit}" for p in finding.parameters
        )
        lines.append(f"  {finding.stage}: {finding.effect} (probability {finding.probability:.3f}): {values}")
    return "\n".join([*lines, f"  unexplained: {found.unexplained or 'nothing'}"])
