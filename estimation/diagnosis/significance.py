"""Whether a term is significant: it has to lower -2 log evidence and to improve samples that were not fitted."""

from __future__ import annotations

import numpy as np

from estimation.diagnosis.fit import Fit, Likelihood

DETECTION_THRESHOLD = 10.0
"""Decrease of -2 log evidence from which a term is detected: a factor of 150 in probability, with a margin for the
choice among some fifty candidates."""

COLOURED_NOISE_SAFETY_FACTOR = 2.5
"""Factor on ``DETECTION_THRESHOLD`` if slow noise with a steeper spectrum explains most of a gain. In simulations the
unexplained gain was 17 to 22 for false drifts and at least 32 for true ones."""

UNIQUE_NAME_THRESHOLD = 6.0
"""Difference in -2 log evidence from which a term is reported as the only explanation: a factor of 20 in probability.
Within it, the next candidate is reported as a rival."""

MIN_VALIDATION_GAIN_RATIO = 0.3
"""Smallest ratio of the gain in chi-square per held-out sample to that per fitted sample. For a true effect it is
nearly 1; less is accepted because an effect may act in a part of the recording only. A gain of ``DETECTION_THRESHOLD``
on the held-out samples is always sufficient."""


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


def is_significant(likelihood: Likelihood, before: Fit, after: Fit) -> bool:
    """Whether a term lowers -2 log evidence by more than the threshold and also improves the held-out samples.

    If a term hardly affects the held-out samples, these must only not become worse, within the scatter of the change.
    Examples are a term that returns a nominal value to its prior, and a clip level that is reached only at the start.
    In a model with a clip level the held-out samples must improve in any case, because clipped slow noise resembles an
    offset in the clipped periods.
    """
    gain = evidence_gain(likelihood, before, after)
    if not gain:
        return False
    validation_gain = float(
        np.sum(before.residual[before.validation_rows] ** 2) - np.sum(after.residual[after.validation_rows] ** 2)
    )
    validation_change = float(
        np.sum((before.residual[before.validation_rows] - after.residual[after.validation_rows]) ** 2)
    )
    fitted_gain = before.chi2 - after.chi2
    not_worse = validation_gain > -2.0 * np.sqrt(validation_change) - 2.0
    if fitted_gain <= before.penalty - after.penalty:
        return not_worse
    required_gain = min(
        MIN_VALIDATION_GAIN_RATIO * fitted_gain * int(after.validation_rows.sum()) / int(after.rows.sum()),
        DETECTION_THRESHOLD,
    )
    beside_clip = any(candidate.term.after_noise for candidate in before.model.candidates)
    if validation_change < required_gain:
        return not_worse and gain > 2.0 * DETECTION_THRESHOLD and not beside_clip
    if gain > (20.0 if before.model.candidates else 4.0) * DETECTION_THRESHOLD and not beside_clip:
        # So large a gain is caused neither by chance nor by an inexact law of another term. The expected gain on
        # held-out samples is then their change, with a standard deviation of twice the square root.
        required_gain = min(required_gain, max(0.0, validation_change - 4.0 * np.sqrt(validation_change)))
    return validation_gain > required_gain
