"""Whether a term is significant: the fall of -2 log evidence that neither chance nor slow noise explains."""

from __future__ import annotations

from estimation.device_fit.fit import Fit, Likelihood

DETECTION_THRESHOLD = 10.0
"""Decrease of -2 log evidence from which a term is detected: a factor of 150 in probability, with a margin for the
choice among some fifty candidates."""

COLOURED_NOISE_SAFETY_FACTOR = 2.5
"""Factor on ``DETECTION_THRESHOLD`` if slow noise with a steeper spectrum explains most of a gain. In simulations the
unexplained gain was 17 to 22 for false drifts and at least 32 for true ones."""

UNIQUE_NAME_THRESHOLD = 6.0
"""Difference in -2 log evidence from which a term is reported as the only explanation: a factor of 20 in probability.
Within it, the next candidate is reported as a rival."""


def satisfies_sign_constraints(fit: Fit) -> bool:
    """Whether every parameter of the terms has a physically possible sign."""
    return all(
        f.parameter is None or f.parameter.sign * fit.x[i] >= 0.0
        for i, f in enumerate(fit.model.parameters)
        if f.kind == "term"
    )


def evidence_gain(likelihood: Likelihood, before: Fit, after: Fit) -> float:
    """Fall of -2 log evidence from ``before`` to ``after``, 0 below the detection threshold.

    The part that slow noise with a steeper spectrum than extrapolated would also explain is subtracted.
    """
    slow_noise_part = likelihood.low_frequency_excess_allowance(before) - likelihood.low_frequency_excess_allowance(
        after
    )
    gain = before.neg2_log_evidence - after.neg2_log_evidence - slow_noise_part
    # if slow noise explains most of the gain, the rest depends on the uncertain steepness of its spectrum
    return (
        gain if gain >= DETECTION_THRESHOLD * (COLOURED_NOISE_SAFETY_FACTOR if slow_noise_part > gain else 1.0) else 0.0
    )
