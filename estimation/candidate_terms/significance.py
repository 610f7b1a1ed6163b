"""Whether a term is significant: the fall of -2 log evidence that neither chance nor slow noise explains."""

from __future__ import annotations

import numpy as np

from estimation.device_fit.fit import Fit, Likelihood
from estimation.device_fit.slow_noise import steeper_noise_gain

DETECTION_THRESHOLD = 10.0
"""Decrease of -2 log evidence from which a term is detected, and the price of each law in the selection: a factor of
150 in probability, with a margin for the choice among some fifty candidates."""

UNIQUE_NAME_THRESHOLD = 6.0
"""Difference in -2 log evidence from which a term is reported as the only explanation: a factor of 20 in probability.
Within it, the next candidate is reported as a rival."""

MIN_RIVAL_PROBABILITY = 1e-4
"""Probability from which a rival is reported with it. A less probable one is reported only if it is not excluded: it
fits as well with more parameters, or was not compared."""

MAX_HELD_OUT_CHI2 = 1.3
"""Held-out reduced chi-square above which a part of the misfit is reported as unexplained."""


def satisfies_sign_constraints(fit: Fit) -> bool:
    """Whether every parameter of the terms has a physically possible sign."""
    return all(has_possible_signs(fit, candidate.term.effect) for candidate in fit.model.candidates)


def has_possible_signs(fit: Fit, effect: str) -> bool:
    """Whether every parameter of the terms with one effect has a physically possible sign."""
    return all(
        fit.model.parameters[i].parameter.sign * fit.x[i] >= 0.0  # type: ignore[union-attr]
        for candidate in fit.model.candidates
        if candidate.term.effect == effect
        for i in fit.model.indices("term", candidate.key)
    )


def evidence_gain(likelihood: Likelihood, before: Fit, after: Fit) -> float:
    """Fall of -2 log evidence from ``before`` to ``after``, 0 below the detection threshold.

    Both are evaluated under the slow noise that suits them best, so that noise with a steeper spectrum than
    extrapolated is no evidence for a drift.
    """
    gain = before.neg2_log_evidence - after.neg2_log_evidence
    gain += steeper_noise_gain(likelihood, after) - steeper_noise_gain(likelihood, before)
    return gain if gain >= DETECTION_THRESHOLD else 0.0


def held_out_gain(before: Fit, after: Fit) -> float:
    """Fall of the misfit of the held-out samples from ``before`` to ``after``, fits under one likelihood."""
    rows = after.validation_rows
    return float(np.sum(before.residual[rows] ** 2) - np.sum(after.residual[rows] ** 2))


def residual_is_noise(fit: Fit) -> bool:
    """Whether the residual of a fit is called noise."""
    return fit.validation_chi2 < MAX_HELD_OUT_CHI2
