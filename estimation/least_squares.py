"""Least squares with Gaussian priors: the damped solver, the Laplace evidence and backward elimination.

Numbers are stated so that their priors have mean zero. Scores are -2 log evidence: lower is better, and a difference of
10 is a factor of 150 in probability. ``scipy.optimize.least_squares`` serves where there are no priors; the solver here
adds priors, held-out samples and the reuse of a Jacobian that costs far more than a residual.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np
from scipy.linalg.lapack import dtrtri

from scanner.arrays import Array, Mask

T = TypeVar("T")

Z_95 = 1.96
"""Half-width of the 95 % interval of a normal distribution in standard deviations."""

INITIAL_DAMPING = 1e-4
"""Levenberg-Marquardt damping of the first step, relative to the diagonal of the normal matrix: nearly Gauss-Newton,
because a fit starts from an estimate that is close."""

MIN_DAMPING, MAX_DAMPING = 1e-9, 1e8
"""Below the first, damping is lost in rounding; above the second, a step is too short to change anything."""

DAMPING_RAISE, DAMPING_LOWER = 6.0, 8.0
"""Factors by which damping grows after a step that raises the misfit and falls after one that lowers it."""

JACOBIAN_REUSE_RATIO = 0.9
"""Share of the predicted fall in misfit from which the Jacobian is kept for one more step."""

MAX_STEPS_PER_JACOBIAN = 10
"""Steps after which a Jacobian is renewed. A diverged model of 1e8 standard deviations may fall by a hundredth of its
misfit in thousands of steps, each of which falls by more than predicted."""

DIVERGED_RATIO = 100.0
"""Misfit over ``abort_above`` from which a fit counts as diverged and gets 2 instead of 4 iterations to improve."""

ABORT_PROGRESS = 0.2
"""Share of the distance to ``abort_above`` by which an iteration must lower the misfit, or the fit is aborted."""

Residual = Callable[[Array], Array]
"""Parameters, shape (p,), to weighted residuals with unit variance, shape (n,)."""

Jacobian = Callable[[Array, Array], Array]
"""Parameters, shape (p,), and the residual there, shape (n,), to the derivative of the residual, shape (n, p)."""


@dataclass(frozen=True)
class LeastSquaresFit:
    """A fit under Gaussian priors.

    Attributes:
        x: parameters, shape (p,).
        residual: of all samples, shape (n,).
        jacobian: derivative of the residual at ``x`` or one step of less than the tolerance before it, shape (n, p).
        rows: samples that were fitted, shape (n,).
        prior_precision: 1 / variance of each parameter's prior, shape (p,).
    """

    x: Array
    residual: Array
    jacobian: Array
    rows: Mask
    prior_precision: Array

    @property
    def chi2(self) -> float:
        """Sum of squares of the fitted residuals."""
        part = self.residual[self.rows]
        return float(part @ part)

    @property
    def penalty(self) -> float:
        """Part of the misfit that the priors add."""
        return float(self.prior_precision @ (self.x * self.x))

    @property
    def information(self) -> Array:
        """Fisher information of the fitted samples without the priors, shape (p, p)."""
        part = self.jacobian[self.rows]
        return np.asarray(part.T @ part)

    @property
    def covariance(self) -> Array:
        """Posterior covariance of ``x``, shape (p, p)."""
        return np.asarray(np.linalg.inv(self.information + np.diag(self.prior_precision)))

    @property
    def neg2_log_evidence(self) -> float:
        """-2 log evidence by Laplace's method; see ``laplace_neg2_log_evidence``."""
        return laplace_neg2_log_evidence(self.chi2 + self.penalty, self.information, self.prior_precision**-0.5)


def fit_levenberg_marquardt(
    residual: Residual,
    jacobian: Jacobian,
    x: Array,
    prior_precision: Array,
    *,
    rows: Mask | None = None,
    fixed: Sequence[int] = (),
    max_step: Array | None = None,
    max_iterations: int = 12,
    tolerance: float = 0.05,
    abort_above: float = np.inf,
) -> LeastSquaresFit:
    """Minimise the squared residual of the fitted samples plus the priors' penalty.

    Args:
        residual: weighted to unit variance. It may return huge but finite values where a model diverges.
        jacobian: its derivative; called with an ``x`` at which the residual was evaluated.
        x: start, shape (p,).
        prior_precision: 1 / variance of each parameter's prior, shape (p,); 0 for no prior.
        rows: samples that are fitted, shape (n,); all by default.
        fixed: indices of parameters that keep their value.
        max_step: largest change of each parameter in one step, shape (p,); a longer step is scaled down as a whole.
        max_iterations: of new Jacobians. 0 evaluates residual and Jacobian at ``x`` and changes nothing.
        tolerance: stop when a step lowers the misfit by less.
        abort_above: misfit of a competing fit. A fit above it that no longer approaches it is stopped early.

    Source: Marquardt, J. SIAM 11, 431 (1963), with damping relative to the diagonal.
    """
    x, current = np.array(x, np.float64), residual(x)
    used = np.ones(current.size, bool) if rows is None else rows
    held = list(fixed)

    def misfit(trial: Array, at: Array) -> float:
        part = at[used]
        return float(part @ part + prior_precision @ (trial * trial))

    value, slopes = misfit(x, current), jacobian(x, current)
    damping, fresh, iteration, kept = INITIAL_DAMPING, True, 0, 0
    while iteration < max_iterations:
        part = slopes[used]
        normal = part.T @ part + np.diag(prior_precision)
        gradient = part.T @ current[used] + prior_precision * x
        normal[held], normal[:, held], gradient[held] = 0.0, 0.0, 0.0
        normal[held, held] = 1.0
        gain = predicted = 0.0
        while damping < MAX_DAMPING:
            try:
                step = -np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient)
            except np.linalg.LinAlgError:  # a diverged model makes the normal matrix singular
                damping *= DAMPING_RAISE
                continue
            if max_step is not None:
                step = step / max(1.0, float(np.max(np.abs(step) / max_step, initial=0.0)))
            trial = residual(x + step)
            trial_value = misfit(x + step, trial)
            if trial_value < value:
                gain, value, current, x = value - trial_value, trial_value, trial, x + step
                predicted = -float(step @ (2.0 * gradient + normal @ step))
                damping = max(damping / DAMPING_LOWER, MIN_DAMPING)
                break
            if gradient @ -step < 0.1 * tolerance:  # even the linear model promises no more than that
                break
            damping *= DAMPING_RAISE
        if fresh and gain < tolerance and iteration > 0:
            break
        kept += 1
        fresh = gain <= max(JACOBIAN_REUSE_RATIO * predicted, tolerance) or kept == MAX_STEPS_PER_JACOBIAN
        if fresh:
            kept = 0
            iteration += 1
            slopes = jacobian(x, current)
            patience = 2 if value > DIVERGED_RATIO * abort_above else 4
            if iteration > patience and gain < ABORT_PROGRESS * (value - abort_above):
                break
    return LeastSquaresFit(x, current, slopes, used, prior_precision)


def laplace_neg2_log_evidence(misfit: float, information: Array, prior_root: Array) -> float:
    """-2 log evidence of a fit by Laplace's method, up to a constant of the data.

    Args:
        misfit: chi-square plus the priors' penalty at the best fit.
        information: Fisher information of the data without the priors, shape (p, p).
        prior_root: standard deviations of independent priors, shape (p,), or a matrix R with R R' the priors'
            covariance, shape (p, p).

    Returns:
        ``misfit`` + log det(1 + R' H R): what the data narrow the parameters by, against their priors.

    Source: MacKay, "Bayesian interpolation", Neural Computation 4, 415 (1992): best fit times Occam factor.
    """
    root = np.diag(prior_root) if prior_root.ndim == 1 else prior_root
    return misfit + float(np.linalg.slogdet(np.eye(len(root)) + root.T @ information @ root)[1])


class GaussianPosterior(NamedTuple):
    """Mean, shape (p,), covariance, shape (p, p), and -2 log evidence up to a constant of the data."""

    mean: Array
    covariance: Array
    neg2_log_evidence: float


def gaussian_posterior(information: Array, score: Array, prior_root: Array) -> GaussianPosterior:
    """Posterior of x under the likelihood exp(-x' H x / 2 + s' x) and a Gaussian prior of mean zero.

    Args:
        information: H, shape (p, p).
        score: s, shape (p,): the gradient of the log likelihood at x = 0.
        prior_root: as for ``laplace_neg2_log_evidence``; a standard deviation of 0 fixes a parameter at 0.
    """
    root = np.diag(prior_root) if prior_root.ndim == 1 else prior_root
    inner = np.eye(len(root)) + root.T @ information @ root
    covariance = np.asarray(root @ np.linalg.inv(inner) @ root.T)
    mean = np.asarray(covariance @ score)
    return GaussianPosterior(mean, covariance, laplace_neg2_log_evidence(-float(score @ mean), information, root))


def eliminate_backward(
    items: Sequence[T],
    score: Callable[[list[T]], float],
    removable: Collection[int] | None = None,
    max_increase: float = 0.0,
) -> tuple[list[T], float]:
    """Remove items one at a time, each time the one whose removal gives the lowest score, while that is allowed.

    Args:
        items: in any order, which is kept.
        score: of a selection, lower is better; as a rule -2 log evidence.
        removable: indices of the items that may be removed; all by default.
        max_increase: by how much one removal may raise the score. With the detection threshold here, an item remains
            only if the data demand it.

    Returns:
        the items that remain, and their score.
    """
    remaining = list(range(len(items)))
    allowed = set(remaining if removable is None else removable)

    def score_of(selection: list[int]) -> float:
        return score([items[i] for i in selection])

    lowest = score_of(remaining)
    while candidates := [[i for i in remaining if i != removed] for removed in remaining if removed in allowed]:
        scores = [score_of(selection) for selection in candidates]
        best = int(np.argmin(scores))
        if not scores[best] <= lowest + max_increase:
            break
        remaining, lowest = candidates[best], scores[best]
    return [items[i] for i in remaining], lowest


def fit_linear(basis: Array, target: Array) -> tuple[Array, Array]:
    """Ordinary least squares, with columns scaled to unit norm so that columns of very different units are accurate.

    Args:
        basis: shape (n, p). target: shape (n,).

    Returns:
        Coefficients, shape (p,), and their covariance for white residuals, shape (p, p).
    """
    size = np.sqrt(np.einsum("ni,ni->i", basis, basis))
    scaled = basis / size
    # einsum, not @: on tall thin matrices the threads of a BLAS cost fifty times what the sums do
    gram = np.linalg.inv(np.einsum("ni,nj->ij", scaled, scaled))
    coefficients = gram @ np.einsum("ni,n->i", scaled, target)
    residual = target - np.einsum("ni,i->n", scaled, coefficients)
    covariance = gram * np.einsum("n,n->", residual, residual) / (target.size - coefficients.size)
    return coefficients / size, covariance / np.outer(size, size)


class Regression(NamedTuple):
    """Least squares with Gaussian priors, by an orthogonal factorisation.

    Attributes:
        factor: upper triangular, shape (q, q); the posterior covariance is the inverse of its square.
        projected: the targets in the space of the columns, shape (q, t). Minus the estimate solves ``factor`` for it.
        remainder: the targets beside the columns, shape (s, t), with the same inner products as what is left of them.
    """

    factor: Array
    projected: Array
    remainder: Array

    @property
    def log_determinant(self) -> float:
        """Of the inverse of the posterior covariance."""
        return 2.0 * float(np.log(np.abs(np.diag(self.factor))).sum())

    @property
    def inverse_factor(self) -> Array:
        """Inverse of ``factor``, shape (q, q); the posterior covariance is its product with its transpose."""
        return np.asarray(dtrtri(self.factor)[0]) if self.factor.size else self.factor


def between_variance(value: Array, sd: Array, significance: float = 0.0) -> float:
    """Variance between measurements of a quantity beyond their standard deviations, 0 where these explain the scatter.

    Source: DerSimonian and Laird, Controlled Clinical Trials 7, 177 (1986): a random effect of each measurement.

    Args:
        value, sd: in one unit, shape (n,); standard deviations above 0.
        significance: excess of chi-square over its degrees of freedom, in its standard deviations, up to which the
            standard deviations explain the scatter.

    Returns:
        in the square of that unit.
    """
    relative = (sd.min() / sd) ** 2  # weights without overflow
    freedom, total = value.size - 1, float(relative.sum())
    shared = float(np.sum(relative * (total - relative)))
    if shared <= 0.0:
        return 0.0
    variance = float(sd.min()) ** 2
    excess = float(np.sum(relative * (value - np.sum(relative * value) / total) ** 2)) - freedom * variance
    return excess * total / shared if excess > significance * np.sqrt(2.0 * freedom) * variance else 0.0


def triangular_factor(columns: Array) -> Array:
    """Upper triangular matrix with the inner products of ``columns``, shape (n, q)."""
    return np.asarray(np.linalg.qr(columns, mode="r"))


def regress(columns: Array, targets: Array, precision: Array) -> Regression:
    """Regress targets (n, t) on columns (n, q) with prior precisions (q,)."""
    size = precision.size
    prior = np.column_stack([np.diag(np.sqrt(precision)), np.zeros((size, targets.shape[1]))])
    triangle = triangular_factor(np.vstack([np.column_stack([columns, targets]), prior]))
    return Regression(triangle[:size, :size], triangle[:size, size:], triangle[size:, size:])
