"""Intervals by profile likelihood: as wide as the misfit allows, on either side for itself."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimation.mismatch.fit import Comparison, Fit, solve

Array = NDArray[np.float64]

SIDE = 1.96
"""Standard deviations to either end of a 95 % interval, where -2 log posterior is a parabola: there it has risen by
the square of this."""

STRAIGHT = 0.1
"""Share by which the root of the rise may miss ``SIDE`` where an end is taken to lie in proportion."""

NEAR = 0.2
"""Of a rise of 3.84, what a refit may leave on the table: 3 % of the way to an end."""

REFITS = 6
"""Points of a bent ridge that are refitted on the way to an end, each at most twice as far as the one before."""


def profile_interval(comparison: Comparison, fit: Fit, i: int) -> tuple[float, float]:
    """95 % interval of x[i].

    The profile is first evaluated where the parabola has its ends: along the ridge of the posterior, all other free
    numbers refitted by one Gauss-Newton step (Venzon & Moolgavkar, Applied Statistics 37, 1988). Where that is not the
    rise that an end has, the ridge is bent (a stiffness that relaxes and its time imitate each other) and is followed.
    """
    ends = [fit.x[i] + _reach(comparison, fit, i, side) for side in (-1.0, 1.0)]
    return float(ends[0]), float(ends[1])


def _reach(comparison: Comparison, fit: Fit, i: int, side: float) -> float:
    covariance, precision = fit.covariance, fit.model.precision
    least, ridge = fit.chi2 + fit.penalty, covariance[:, i] / covariance[i, i]
    reach = float(side * SIDE * np.sqrt(covariance[i, i]))

    def over(misfit: float) -> float:
        """Root of the rise to a misfit, in units of what it is at an end."""
        return float(np.sqrt(max(misfit - least, 1e-12)) / SIDE)

    x = fit.x + ridge * reach
    others = np.arange(x.size) != i
    part = fit.jacobian[np.ix_(fit.rows, others)]
    residual = comparison.residual(fit.model, x)[fit.rows]
    gradient = part.T @ residual + precision[others] * x[others]
    refitted = x.copy()
    refitted[others] -= np.linalg.solve(part.T @ part + np.diag(precision[others]), gradient)
    again = comparison.residual(fit.model, refitted)[fit.rows]
    far = over(min(r @ r + precision @ (at * at) for r, at in ((residual, x), (again, refitted))))
    for _ in range(REFITS):
        if abs(far - 1.0) < STRAIGHT:
            break
        reach *= np.clip(1.0 / far, 0.5, 2.0)
        at = solve(comparison, fit.model, fit.x + ridge * reach, turns=4, tolerance=NEAR, fixed=i)
        ridge, far = (at.x - fit.x) / reach, over(at.chi2 + at.penalty)
    return float(reach / np.clip(far, 0.5, 2.0))
