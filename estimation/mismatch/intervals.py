"""Intervals by profile likelihood: as wide as the misfit allows, on either side for itself."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimation.mismatch.fit import Comparison, Fit

Array = NDArray[np.float64]

SIDE = 1.96
"""Standard deviations to either end of a 95 % interval, where -2 log posterior is a parabola: there it has risen by
the square of this."""

WIDEST = 3.0
"""An end lies at most this many times as far off, and at least as near, as the parabola says."""


def profile_interval(comparison: Comparison, fit: Fit, i: int) -> tuple[float, float]:
    """95 % interval of x[i].

    The profile is evaluated where the parabola has its ends: along the ridge of the posterior, all other free numbers
    refitted by one Gauss-Newton step. The end is moved to where the same rise would stand on a parabola through that
    point (Venzon & Moolgavkar, Applied Statistics 37, 1988, in one step).
    """
    ends = [fit.x[i] + _reach(comparison, fit, i, side) for side in (-1.0, 1.0)]
    return float(ends[0]), float(ends[1])


def _reach(comparison: Comparison, fit: Fit, i: int, side: float) -> float:
    covariance, precision = fit.covariance, fit.model.precision
    reach = side * SIDE * np.sqrt(covariance[i, i])
    x = fit.x + covariance[:, i] / covariance[i, i] * reach
    others = np.arange(x.size) != i
    rows = fit.rows
    part = fit.jacobian[np.ix_(rows, others)]
    residual = comparison.residual(fit.model, x)[rows]
    gradient = part.T @ residual + precision[others] * x[others]
    refitted = x.copy()
    refitted[others] -= np.linalg.solve(part.T @ part + np.diag(precision[others]), gradient)
    again = comparison.residual(fit.model, refitted)[rows]
    values = [r @ r + precision @ (at * at) for r, at in ((residual, x), (again, refitted))]
    rise = max(min(values) - fit.chi2 - fit.penalty, 1e-300)
    return float(reach * np.clip(SIDE / np.sqrt(rise), 1.0 / WIDEST, WIDEST))
