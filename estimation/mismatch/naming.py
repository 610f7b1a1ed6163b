"""Which physics is missing: every candidate fitted inside the full model, compared by evidence."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from estimation.mismatch.fit import Comparison, Fit, solve
from estimation.mismatch.model import Candidate
from estimation.mismatch.screen import Screened, screen

Array = NDArray[np.float64]

LEAD_OVER_NOTHING = 10.0
"""Fall of -2 log evidence from which a term is said to be there at all."""

LEAD_OVER_NEXT = 6.0
"""Lead from which a term is named alone; within it, the next is named beside it."""

TRACKED = 2.0
"""Reduced chi-square up to which a fit follows the motion, so that first order holds around it."""

FINALISTS = 6
Progress = Callable[[str], None]


def possible(fit: Fit) -> bool:
    """Whether every parameter has a sign that physics allows."""
    return all(
        f.parameter is None or f.parameter.sign * fit.x[i] >= 0.0
        for i, f in enumerate(fit.model.free)
        if f.kind == "term"
    )


def convincing(before: Fit, after: Fit) -> bool:
    """Whether a term is there: well ahead of nothing, and no worse on samples that no fit has seen.

    A pull on the nominal values that a term relieves is evidence that no held-out sample shows, so those may stay as
    they were, within the scatter of what the term changes there.
    """
    if before.evidence - after.evidence < LEAD_OVER_NOTHING:
        return False
    gained = float(np.sum(before.residual[before.held] ** 2) - np.sum(after.residual[after.held] ** 2))
    changed = float(np.sum((before.residual[before.held] - after.residual[after.held]) ** 2))
    in_residual = before.chi2 - after.chi2 > before.penalty - after.penalty
    return gained > 0.0 if in_residual else gained > -2.0 * np.sqrt(changed) - 2.0


def near(comparison: Comparison, base: Fit, candidates: Sequence[Candidate], threshold: float = 3.0) -> list[Fit]:
    """Fits of the candidates that first order around ``base`` promises anything of, best first."""
    promising = sorted((screen(comparison, base, each) for each in candidates), key=lambda s: -s.gain)
    promising = [each for each in promising if each.gain > threshold]
    fits: list[Fit] = []
    for each in promising:
        if len(fits) >= FINALISTS and each.gain < 0.5 * promising[0].gain:
            break
        fits.append(solve(comparison, each.model, each.x))
    return sorted((fit for fit in fits if possible(fit)), key=lambda fit: fit.evidence)


def race(comparison: Comparison, early: Fit, stops: Sequence[float], candidates: Sequence[Candidate]) -> list[Fit]:
    """Fits of candidates that grow window by window from where the nominal model could still follow; laggards drop out.

    A nominal model that has lost the motion's phase is nothing to linearise around: the candidates start where it held.
    """
    base = solve(comparison, early.model, early.x, stops[0], 8)
    field: list[Screened] = [screen(comparison, base, each, stops[0]) for each in candidates]
    running = [(each.model, each.x, np.full(each.x.size, 1e-4)) for each in field]
    fits: list[Fit] = []
    for stop in stops:
        turns, tolerance = (14, 0.05) if stop == stops[-1] else (6, 1.0)
        fits = [solve(comparison, model, x, stop, turns, steps, tolerance) for model, x, steps in running]
        fits.sort(key=lambda fit: fit.evidence if possible(fit) else np.inf)
        best, worst = fits[0].evidence, max(fit.evidence for fit in fits)
        margin = max(60.0, 0.5 * (worst - best))
        kept = [fit for fit in fits if fit.evidence < best + margin]
        if stop * 4 > stops[-1]:
            kept = kept[:FINALISTS]
        running = [(fit.model, fit.x, np.full(fit.x.size, 1e-4)) for fit in kept]
    return [fit for fit in fits if possible(fit)]
