"""Confidence intervals by profile likelihood, with both ends computed separately."""

from __future__ import annotations

import numpy as np

from estimation.diagnosis.fit import Fit, Likelihood, fit_model

Z_95 = 1.96
"""Half-width of a 95 % interval in standard deviations. At its ends, -2 log posterior has risen by the square of
this."""

PARABOLIC_TOLERANCE = 0.1
"""Relative error of the square root of the rise up to which an end is found by scaling, as on a parabola."""

PROFILE_TOLERANCE = 0.2
"""Misfit that a refit at a fixed parameter may leave. Of a rise of 3.84 it moves an end of the interval by 3 %."""

MAX_PROFILE_REFITS = 6
"""Refits on the way to one end of an interval. Each moves by a factor of two at most, so six reach a factor of 64."""


def profile_interval(likelihood: Likelihood, fit: Fit, i: int) -> tuple[float, float]:
    """95 % interval of x[i].

    The profile is first evaluated at the ends of the parabolic interval, with all other parameters refitted by one
    Gauss-Newton step. Where the rise there is not that of an interval's end, the likelihood is not parabolic, and the
    end is searched by refits.

    Source: Venzon & Moolgavkar, Applied Statistics 37, 87 (1988).
    """
    ends = [fit.x[i] + _profile_endpoint(likelihood, fit, i, side) for side in (-1.0, 1.0)]
    return float(ends[0]), float(ends[1])


def _profile_endpoint(likelihood: Likelihood, fit: Fit, i: int, side: float) -> float:
    """Distance from x[i] to the end of its interval on one side, -1 or 1."""
    covariance, precision = fit.covariance, fit.model.precision
    minimum, ridge = fit.chi2 + fit.penalty, covariance[:, i] / covariance[i, i]
    reach = float(side * Z_95 * np.sqrt(covariance[i, i]))

    def relative_rise(misfit: float) -> float:
        """Square root of the rise to a misfit, relative to that at an end of the interval."""
        return float(np.sqrt(max(misfit - minimum, 1e-12)) / Z_95)

    x = fit.x + ridge * reach
    others = np.arange(x.size) != i
    fitted = fit.jacobian[np.ix_(fit.rows, others)]
    residual = likelihood.residual(fit.model, x)[fit.rows]
    gradient = fitted.T @ residual + precision[others] * x[others]
    refitted = x.copy()
    refitted[others] -= np.linalg.solve(fitted.T @ fitted + np.diag(precision[others]), gradient)
    refitted_residual = likelihood.residual(fit.model, refitted)[fit.rows]
    rise = relative_rise(
        min(r @ r + precision @ (trial * trial) for r, trial in ((residual, x), (refitted_residual, refitted)))
    )
    for _ in range(MAX_PROFILE_REFITS):
        if abs(rise - 1.0) < PARABOLIC_TOLERANCE:
            break
        reach *= np.clip(1.0 / rise, 0.5, 2.0)
        trial = fit_model(
            likelihood, fit.model, fit.x + ridge * reach, max_iterations=4, tolerance=PROFILE_TOLERANCE, fixed=i
        )
        ridge, rise = (trial.x - fit.x) / reach, relative_rise(trial.chi2 + trial.penalty)
    return float(reach / np.clip(rise, 0.5, 2.0))
