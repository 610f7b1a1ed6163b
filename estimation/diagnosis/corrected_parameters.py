"""Parameters of a fit beside corrections of all stages, where laws leave more than noise.

What no law describes biases the parameters of the laws that are fitted without it, by many of their standard
deviations. Beside corrections of all stages the bias is estimated with them, and the standard deviations contain it.

Source: Kennedy & O'Hagan, J. R. Stat. Soc. B 63, 425 (2001).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from estimation.candidate_terms.linear_model import MAX_SCALE_BESIDE, LinearModel
from estimation.device_fit.fit import Fit
from estimation.least_squares import Z_95, regress
from scanner.arrays import Array


class CorrectedParameters(NamedTuple):
    """Parameters of a fit beside corrections.

    Attributes:
        mean: shape (p,), in prior standard deviations.
        sd: of each, shape (p,).
    """

    mean: Array
    sd: Array

    def widen(self, i: int, ends: tuple[float, float]) -> tuple[float, float]:
        """A 95 % interval of parameter i without corrections, extended to that beside them."""
        half = Z_95 * float(self.sd[i])
        return min(ends[0], float(self.mean[i]) - half), max(ends[1], float(self.mean[i]) + half)


def correct_parameters(fit: Fit, corrections: LinearModel) -> CorrectedParameters:
    """Mean and standard deviation of all parameters of a fit beside corrections, to first order.

    Args:
        corrections: see :func:`estimation.candidate_terms.linearisation.linear_model_of_corrections`.
    """
    scales = corrections.hypothesis((), max_scale=MAX_SCALE_BESIDE).scales
    precision = np.repeat(1.0 / scales, [term.columns.size for term in corrections.discrepancies])
    regression = regress(corrections.factor[:, :-1], corrections.factor[:, -1:], precision)
    by_coefficient = corrections.profile[:, :-1] @ regression.inverse_factor
    mean = by_coefficient @ regression.projected[:, 0] - corrections.profile[:, -1]
    variance = np.diag(fit.covariance) + np.sum(by_coefficient**2, axis=1)
    return CorrectedParameters(mean, np.sqrt(variance))
