"""Which law explains the free decays of one axis: generalised least squares with a model error beside every law.

The whitened misfit of a law is chi2 = r' C^-1 r with C = white noise + delta^2 K. K is a Matern 3/2 covariance in time:
the error that every model of a real detector leaves. It grows with the square root of the amplitude that is lost,
because detectors have offsets and leakage too. Its size delta is unknown; each law is judged by its evidence over all
sizes,

    score = -2 ln mean_delta exp(-(chi2 + ln det C) / 2) + (parameters) ln n + 2 ln(number of laws).

A law is therefore needed only where no error of a detector explains the decay as well. Laws are fitted to two thirds of
the samples, in blocks; the errors that are reported are those on the other blocks.

Sources: Kennedy and O'Hagan, J. R. Stat. Soc. B 63 (2001) 425 (model error); Schwarz, Ann. Stat. 6 (1978) 461.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from estimation.device_fit.open_loop import OpenLoop
from estimation.signals import robust_sd
from estimation.slow.decay import LAWS, Decay, Law, log_amplitude
from scanner.arrays import Array
from scanner.errors import BadInput

MODEL_ERRORS: Array = 1e-3 * np.exp2(np.arange(5.0))
"""Relative errors of amplitude that are expected of every model, equally probable: detectors follow their law to
0.01 dB (0.1 %) at best, 0.15 dB (1.6 %) at worst."""

UNKNOWN_LAW_ERRORS: Array = MODEL_ERRORS[-1] * np.exp2(np.arange(1.0, 6.0))
"""Relative errors of amplitude that an unlisted law of damping leaves, equally probable: all that exceed a detector's,
up to half of the amplitude."""

MODEL_ERROR_LENGTH = 1.0 / 6.0
"""Correlation time of the relative error, as a fraction of the duration."""

HELD_OUT_BLOCKS = 21
"""Blocks of equal time into which a decay is divided; every third is held out, the first and the last are not."""

RELEASED_FRACTION = 0.97
"""Fraction of the largest amplitude at which the decay is taken to begin: a drive does not end within one sample."""

LEAST_AMPLITUDE = 1e-3
"""Fraction of the largest amplitude below which samples are not used: offsets and leakage of detectors are as large."""

MIN_POINTS, MIN_LOG_DECAY = 30, 0.1
"""Samples of a decay, and decay of ln A, that are needed at least."""

MIN_DRIFT_TIME = 0.05
"""Least time constant of a drift, as a fraction of the duration: a faster one is the end of the drive."""

MAX_POINTS = 100
"""Points of a decay after compression: enough for a curve of some ten parameters, and the covariance stays small."""

MAX_OUTLIER_SD = 5.0
"""Residual from a running median, in standard deviations, above which a point is left out: a glitch."""

FREE_KNOTS = 9
"""Knots of the cubic spline that stands for any law: fewer than the 14 blocks that are fitted."""

START_COEFFICIENTS = (-0.3, 0.3, 3.0)
"""Starts of a law's coefficient times duration; of a drift the relative change."""


class Decays(NamedTuple):
    """Free decays of one axis, which share its law.

    Attributes:
        parts: each decay.
        duration: T, the longest duration [s].
        reference: largest first amplitude, in the unit of the measurement.
    """

    parts: tuple[Decay, ...]
    duration: float
    reference: float

    @classmethod
    def of(cls, parts: Sequence[Decay]) -> Decays:
        longest = max(float(part.time[-1]) for part in parts)
        return cls(tuple(parts), longest, max(part.first_amplitude for part in parts))

    def log_relative(self, part: Decay) -> Array:
        """ln of the amplitude of one decay over the reference amplitude, shape (n,)."""
        return part.log_amplitude + np.log(part.first_amplitude / self.reference)


@dataclass(frozen=True)
class DecayFit:
    """One law fitted to decays.

    Attributes:
        law: None for a constant rate.
        shared: parameters that all decays have in common, see ``log_amplitude``. covariance: of them.
        score: -2 ln evidence, with the price of parameters and of the number of laws.
        predicted: ln of the amplitude of every decay over the reference amplitude.
    """

    law: Law | None
    shared: Array
    covariance: Array
    score: float
    predicted: tuple[Array, ...]


def compress(time: Array, amplitude: Array) -> Decay:
    """The decay from the largest amplitude on, without glitches, in at most ``MAX_POINTS`` points.

    Args:
        time: [s], amplitude: in any linear unit, shape (n,).

    Raises:
        BadInput: no decay.
    """
    from scipy.ndimage import median_filter

    good = np.isfinite(amplitude) & (amplitude > 0.0)
    if not good.any():
        hint = "check the sign of the amplitude, and repair samples that are not finite"
        raise BadInput("gives no amplitude above 0", hint=hint)
    time, y = time[good], np.log(amplitude[good])
    smooth = median_filter(y, 5)
    first = int(np.flatnonzero(smooth > smooth.max() + np.log(RELEASED_FRACTION))[-1]) + 1
    below = np.flatnonzero(smooth[first:] < smooth.max() + np.log(LEAST_AMPLITUDE))
    last = first + int(below[0]) if below.size else y.size
    time, y = time[first:last], y[first:last]
    if y.size < MIN_POINTS or y.min() > y[0] - MIN_LOG_DECAY:
        left = np.exp(y.min() - y[0]) if y.size else 1.0
        what = f"shows no free decay: {y.size} samples after its largest value, {left:.0%} of the amplitude are left"
        raise BadInput(what, hint="record a free decay until a third of the amplitude is left")
    width = -(-y.size // MAX_POINTS)
    n = y.size // width * width
    noise = _white_noise(y)
    away = np.abs(y - median_filter(y, 11)) > MAX_OUTLIER_SD * np.maximum(noise, 1e-4)
    weight = np.where(away, 0.0, 1.0)[:n].reshape(-1, width)
    total = weight.sum(axis=1)
    used = total > 0.0
    mean = [(values[:n].reshape(-1, width) * weight).sum(axis=1)[used] / total[used] for values in (time, y, noise**2)]
    scatter = np.sqrt(np.maximum(mean[2] / total[used], _white_noise(mean[1]) ** 2))
    return Decay(mean[0] - mean[0][0], mean[1] - mean[1][0], scatter, float(np.exp(mean[1][0])))


def _white_noise(y: Array) -> Array:
    """Standard deviation of the white noise of a smooth curve at every sample, from second differences."""
    differences = np.diff(y, n=2)
    parts = np.array_split(np.arange(differences.size), 4)
    sds = [robust_sd(differences[part]) / np.sqrt(6.0) for part in parts]
    middles = [part.mean() + 1.0 for part in parts]
    return np.maximum(np.interp(np.arange(y.size), middles, sds), 1e-6)


def held_out(part: Decay) -> Array:
    """Blocks of the samples that are held out, -1 for samples that are fitted, shape (n,)."""
    block = np.minimum(part.time / part.time[-1] * HELD_OUT_BLOCKS, HELD_OUT_BLOCKS - 1).astype(int)
    return np.where(block % 3 == 1, block, -1)


def covariance_root(part: Decay, model_error: float) -> Array:
    """Cholesky root of the covariance of ln A at the fitted samples, shape (n, n)."""
    fitted = held_out(part) < 0
    unit = part.time[fitted] / part.time[-1]
    lag = np.sqrt(3.0) * np.abs(unit[:, None] - unit) / MODEL_ERROR_LENGTH
    error = model_error * np.exp(-0.5 * part.log_amplitude[fitted])
    covariance = np.outer(error, error) * (1.0 + lag) * np.exp(-lag)
    return np.linalg.cholesky(covariance + np.diag(part.noise_sd[fitted] ** 2))


def fit_law(decays: Decays, law: Law | None, rate: float | None = None, model_errors: Array = MODEL_ERRORS) -> DecayFit:
    """Fit a law to the samples that are not held out, from several starts, for every size of the model error.

    Args:
        decays: of one axis.
        law: None for a constant rate.
        rate: of the nominal decay [1/s] if it is not fitted.
        model_errors: relative errors of amplitude that are equally probable beside the law.
    """
    from scipy.linalg import solve_triangular
    from scipy.optimize import least_squares

    units = [part.time / decays.duration for part in decays.parts]
    measured = [decays.log_relative(part) for part in decays.parts]
    fitted = [held_out(part) < 0 for part in decays.parts]
    free = rate is None
    known = [] if rate is None else [np.log(rate * decays.duration)]
    first = [_late_slope(units[0][fitted[0]], measured[0][fitted[0]])] if free else []
    ends = np.array([(y[0], min(float(y[rows].min()) - 2.0, -4.0)) for y, rows in zip(measured, fitted, strict=True)])
    of_law = [[]] if law is None else [[c, np.log(0.3)][: law.parameters] for c in START_COEFFICIENTS]
    begins = [np.concatenate([first, start, ends.ravel()]) for start in of_law]
    count = begins[0].size - ends.size  # shared parameters that are fitted

    def predict(x: Array) -> list[Array]:
        shared = np.concatenate([known, x[:count]])
        pairs = x[count:].reshape(-1, 2)
        return [
            log_amplitude(shared, start, floor, law, unit) for (start, floor), unit in zip(pairs, units, strict=True)
        ]

    low, high = np.full(begins[0].size, -np.inf), np.full(begins[0].size, np.inf)
    low[count + 1 :: 2] = -30.0
    if free:
        low[0], high[0] = np.log(1e-6), np.log(60.0)
    if law is not None and law.power is None:
        low[count - 2 : count], high[count - 2 : count] = (-0.95, np.log(MIN_DRIFT_TIME)), (50.0, np.log(5.0))
    added = 0 if law is None else law.parameters
    n = sum(int(rows.sum()) for rows in fitted)
    price = added * np.log(n) + (2.0 * np.log(len(LAWS)) if added else 0.0)
    scores, solutions = [], []
    for model_error in model_errors:
        roots = [covariance_root(part, model_error) for part in decays.parts]

        def residual(x: Array, roots: list[Array] = roots) -> Array:
            whole = zip(roots, measured, predict(x), fitted, strict=True)
            return np.concatenate([solve_triangular(root, (y - p)[rows], lower=True) for root, y, p, rows in whole])

        fits = [least_squares(residual, begin, bounds=(low, high), x_scale="jac") for begin in begins]
        fit = min(fits, key=lambda each: each.cost)
        begins = [fit.x]  # of the next size of the model error
        log_determinant = 2.0 * sum(float(np.log(np.diag(root)).sum()) for root in roots)
        scores.append(2.0 * float(fit.cost) + log_determinant + price)
        solutions.append(fit)
    best = solutions[int(np.argmin(scores))]
    covariance = np.linalg.pinv(best.jac.T @ best.jac)[:count, :count]
    shared = np.concatenate([known, best.x[:count]])
    return DecayFit(law, shared, covariance, _average_score(scores), tuple(predict(best.x)))


def _late_slope(unit: Array, measured: Array) -> float:
    """ln of the rate of decay times T in the second half of a decay."""
    late = unit > 0.5 * unit[-1]
    return float(np.log(max(-float(np.polyfit(unit[late], measured[late], 1)[0]), 1e-3)))


def fit_curve(decays: Decays, common: bool = False) -> DecayFit:
    """Splines of ln A over time in place of any law; no parameters are stated.

    Args:
        decays: of one axis.
        common: one function of the time from the start for all decays, which differ by a factor alone, as a drift of
            the gain allows; otherwise each decay has its own.
    """
    from scipy.interpolate import BSpline
    from scipy.linalg import block_diag, solve_triangular

    knots, parts = np.concatenate([np.zeros(3), np.linspace(0.0, 1.0, FREE_KNOTS), np.ones(3)]), decays.parts
    units = [part.time / (decays.duration if common else part.time[-1]) for part in parts]
    bases = [BSpline.design_matrix(np.clip(unit, 0.0, 1.0 - 1e-12), knots, 3).toarray() for unit in units]
    factors = block_diag(*[np.ones((unit.size, 1)) for unit in units])
    design = np.column_stack([factors[:, 1:], np.concatenate(bases)]) if common else block_diag(*bases)
    y = np.concatenate([decays.log_relative(part) for part in parts])
    fitted = np.concatenate([held_out(part) < 0 for part in parts])
    price = (design.shape[1] - 1 - 2 * len(parts)) * np.log(fitted.sum())  # more than those of a constant rate
    scores, solutions = [], []
    for model_error in MODEL_ERRORS:
        root = block_diag(*[covariance_root(part, model_error) for part in parts])
        A, b = (solve_triangular(root, each[fitted], lower=True) for each in (design, y))
        solutions.append(np.linalg.lstsq(A, b, rcond=None)[0])
        chi2 = float(np.sum((b - A @ solutions[-1]) ** 2))
        scores.append(chi2 + 2.0 * float(np.log(np.diag(root)).sum()) + price)
    predicted = design @ solutions[int(np.argmin(scores))]
    ends = np.cumsum([unit.size for unit in units])[:-1]
    return DecayFit(None, np.empty(0), np.empty((0, 0)), _average_score(scores), tuple(np.split(predicted, ends)))


def rate_price(decays: Decays) -> float:
    """Amount by which a fitted rate of decay has to lower the score below that of the nominal rate: ln n."""
    return float(np.log(sum(int((held_out(part) < 0).sum()) for part in decays.parts)))


def _average_score(scores: Sequence[float]) -> float:
    """-2 ln of the mean evidence over the sizes of the model error."""
    least = min(scores)
    return least - 2.0 * float(np.log(np.mean(np.exp(-0.5 * (np.array(scores) - least)))))


def prediction_errors(decays: Decays, predicted: Sequence[Array]) -> list[OpenLoop]:
    """Error of the amplitude of every decay on the samples that are held out, in the unit of the measurement.

    Args:
        decays: of one axis.
        predicted: ln of the amplitude of every decay over the reference amplitude.
    """
    errors = []
    for part, log_a in zip(decays.parts, predicted, strict=True):
        block = held_out(part)
        amplitude = decays.reference * np.exp(decays.log_relative(part))
        squares = (amplitude - decays.reference * np.exp(log_a)) ** 2
        means = np.array([squares[block == each].mean() for each in np.unique(block[block >= 0])])
        errors.append(OpenLoop(means, float(np.sqrt(np.mean(amplitude[block >= 0] ** 2)))))
    return errors
