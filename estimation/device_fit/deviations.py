"""Whether the fitted values of a device are probable under their tolerances."""

from __future__ import annotations

from scipy.special import gammaincc

from scanner.arrays import Array

MIN_PULL_PROBABILITY = 1e-3
"""Probability of nominal values as far from the stated ones, in tolerances, below which they have absorbed a misfit, or
contradict their tolerances: one false alarm in a thousand recordings without any effect."""


def deviations_are_improbable(deviations: Array, probability: float = MIN_PULL_PROBABILITY) -> bool:
    """Whether all deviations together are larger than those of right tolerances, but with ``probability``.

    Args:
        deviations: of the fitted values from the stated ones, in tolerances, shape (n,).
    """
    return bool(gammaincc(deviations.size / 2, deviations @ deviations / 2) < probability)
