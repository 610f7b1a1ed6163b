"""Confidence intervals by profile likelihood, with both ends computed separately."""

from __future__ import annotations

import numpy as np

from estimation.device_fit.fit import Fit, Likelihood, fit_model, misfit
from estimation.least_squares import Z_95

PARABOLIC_TOLERANCE = 0.1
"""Relative error of the square root of the rise up to which an end is found by scaling, as on a parabola."""

PROFILE_TOLERANCE = 0.2
"""Tolerance of the misfit of a refit at a fixed parameter. Relative to the rise of 3.84 it changes an end of the
interval by 3 %."""

MAX_PROFILE_REFITS = 6
"""Largest number of refits in the search for one end of an interval. Each changes the distance by at most a factor of
two, so six reach a factor of 64."""


def profile_interval(likelihood: Likelihood, fit: Fit, i: int) -> tuple[float, float]:
    """95 % interval of x[i], (lower end, upper end), in prior standard deviations.

    The profile is first evaluated at the ends of the parabolic interval, with all other parameters refitted by one
    Gauss-Newton step. If the rise there is not that at an end of the interval, the likelihood is not parabolic, and the
    end is searched by refits.

    Source: Venzon & Moolgavkar, Applied Statistics 37, 87 (1988).
    """
    ends = [fit.x[i] + _profile_endpoint(likelihood, fit, i, side) for side in (-1.0, 1.0)]
    return float(ends[0]), float(ends[1])


def _profile_endpoint(likelihood: Likelihood, fit: Fit, i: int, side: float) -> float:
    """Distance from x[i] to the end of its interval on one side, -1 or 1."""
    covariance, precision = fit.covariance, fit.model.precision
    minimum, ridge = misfit(fit), covariance[:, i] / covariance[i, i]
    distance = float(side * Z_95 * np.sqrt(covariance[i, i]))

    def relative_rise(value: float) -> float:
        """Square root of the rise of the misfit to a value, relative to that at an end of the interval."""
        return float(np.sqrt(max(value - minimum, 1e-12)) / Z_95)

    x = fit.x + ridge * distance
    is_free = np.arange(x.size) != i
    fitted = fit.jacobian[np.ix_(fit.rows, is_free)]
    residual = likelihood.residual(fit.model, x)[fit.rows]
    gradient = fitted.T @ residual + precision[is_free] * x[is_free]
    refitted = x.copy()
    refitted[is_free] -= np.linalg.solve(fitted.T @ fitted + np.diag(precision[is_free]), gradient)
    refitted_residual = likelihood.residual(fit.model, refitted)[fit.rows]
    rise = relative_rise(
        min(r @ r + precision @ (trial * trial) for r, trial in ((residual, x), (refitted_residual, refitted)))
    )
    for _ in range(MAX_PROFILE_REFITS):
        if abs(rise - 1.0) < PARABOLIC_TOLERANCE:
            break
        distance *= np.clip(1.0 / rise, 0.5, 2.0)
        trial = fit_model(
            likelihood, fit.model, fit.x + ridge * distance, max_iterations=4, tolerance=PROFILE_TOLERANCE, fixed=(i,)
        )
        ridge, rise = (trial.x - fit.x) / distance, relative_rise(misfit(trial))
    return float(distance / np.clip(rise, 0.5, 2.0))
