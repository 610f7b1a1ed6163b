"""Which law explains a free decay: generalised least squares with a small model error beside every law.

The whitened misfit of a law is chi2 = r' C^-1 r with C = white noise + delta^2 K. K is a squared-exponential covariance
in time: the error that every model of a real detector leaves. It grows with the square root of the amplitude that is
lost, because detectors have offsets and leakage too. A law is judged by

    score = chi2 + (parameters) ln n + 2 ln(number of laws)

Sources: Kennedy and O'Hagan, J. R. Stat. Soc. B 63 (2001) 425 (model error); Schwarz, Ann. Stat. 6 (1978) 461.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estimation.slow.decay import LAWS, Decay, Law, log_amplitude
from scanner.arrays import Array
from scanner.errors import BadInput

MODEL_ERROR = 0.004
"""Relative error of amplitude that is expected of every model: logarithmic detectors follow their law to 0.05 dB."""

MODEL_ERROR_LENGTH = 1.0 / 6.0
"""Correlation time of the relative error ``MODEL_ERROR``, as a fraction of the duration."""

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
"""Knots of the cubic spline that stands for any law."""

START_COEFFICIENTS = (-0.3, 0.3, 3.0)
"""Starts of a law's coefficient times duration; of a drift the relative change."""


@dataclass(frozen=True)
class DecayFit:
    """One law fitted to a decay.

    Attributes:
        law: None for a constant rate.
        x: parameters of ``log_amplitude``. covariance: of them.
        chi2: whitened misfit. score: with the price of parameters and of the number of laws.
        rms: residual of A relative to the rms of A.
    """

    law: Law | None
    x: Array
    covariance: Array
    chi2: float
    score: float
    rms: float


def compress(time: Array, amplitude: Array) -> Decay:
    """The decay from the largest amplitude on, without glitches, in at most ``MAX_POINTS`` points.

    Args:
        time: [s], amplitude: in any linear unit, shape (n,).

    Raises:
        BadInput: no decay.
    """
    from scipy.ndimage import median_filter

    good = np.isfinite(amplitude) & (amplitude > 0.0)
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
    sds = [float(np.median(np.abs(differences[part]))) / 0.6745 / np.sqrt(6.0) for part in parts]
    middles = [part.mean() + 1.0 for part in parts]
    return np.maximum(np.interp(np.arange(y.size), middles, sds), 1e-6)


def covariance_root(decay: Decay) -> Array:
    """Cholesky root of the covariance of ln A, shape (n, n)."""
    unit = decay.time / decay.time[-1]
    lag = (unit[:, None] - unit) / MODEL_ERROR_LENGTH
    error = MODEL_ERROR * np.exp(-0.5 * decay.log_amplitude)
    return np.linalg.cholesky(np.outer(error, error) * np.exp(-0.5 * lag**2) + np.diag(decay.noise_sd**2))


def fit_law(decay: Decay, law: Law | None, root: Array, laws: Sequence[Law] = LAWS) -> DecayFit:
    """Fit a law by generalised least squares, from several starts."""
    from scipy.linalg import solve_triangular
    from scipy.optimize import least_squares

    unit, y = decay.time / decay.time[-1], decay.log_amplitude
    half = unit > 0.5
    slope = max(-float(np.polyfit(unit[half], y[half], 1)[0]), 1e-3)
    begin = np.array([y[0], np.log(slope), min(float(y.min()) - 2.0, -4.0)])

    def residual(x: Array) -> Array:
        return np.asarray(solve_triangular(root, y - log_amplitude(x, law, unit), lower=True))

    starts = [begin] if law is None else [np.append(begin, np.zeros(law.parameters)) for _ in START_COEFFICIENTS]
    if law is not None:
        for start, coefficient in zip(starts, START_COEFFICIENTS, strict=True):
            start[3] = coefficient
            start[4:] = np.log(0.3)
    low = np.full(starts[0].size, -np.inf)
    low[2] = -30.0
    high = np.full(starts[0].size, np.inf)
    low[1], high[1] = np.log(1e-6), np.log(60.0)
    if law is not None and law.power is None:
        low[3:], high[3:] = (-0.95, np.log(MIN_DRIFT_TIME)), (50.0, np.log(5.0))
    fits = [least_squares(residual, start, bounds=(low, high), x_scale="jac") for start in starts]
    best = min(fits, key=lambda fit: fit.cost)
    chi2, added = 2.0 * float(best.cost), 0 if law is None else law.parameters
    price = added * np.log(y.size) + (2.0 * np.log(len(laws)) if added else 0.0)
    rms = _amplitude_error(y, log_amplitude(best.x, law, unit))
    return DecayFit(law, best.x, np.linalg.pinv(best.jac.T @ best.jac), chi2, chi2 + price, rms)


def _amplitude_error(measured: Array, fitted: Array) -> float:
    """Difference of two amplitudes, rms over the rms of the first, from their logarithms."""
    return float(np.sqrt(np.mean((np.exp(measured) - np.exp(fitted)) ** 2) / np.mean(np.exp(2.0 * measured))))


def fit_free_curve(decay: Decay, root: Array) -> tuple[float, float]:
    """Score of a spline in place of any law, and its residual as ``DecayFit.rms``."""
    from scipy.interpolate import BSpline
    from scipy.linalg import solve_triangular

    unit = decay.time / decay.time[-1]
    knots = np.concatenate([np.zeros(3), np.linspace(0.0, 1.0, FREE_KNOTS), np.ones(3)])
    basis = BSpline.design_matrix(np.clip(unit, 0.0, 1.0 - 1e-12), knots, 3).toarray()
    A, b = (solve_triangular(root, each, lower=True) for each in (basis, decay.log_amplitude))
    coefficients = np.linalg.lstsq(A, b, rcond=None)[0]
    chi2 = float(np.sum((b - A @ coefficients) ** 2))
    rms = _amplitude_error(decay.log_amplitude, basis @ coefficients)
    return chi2 + (basis.shape[1] - 3) * np.log(unit.size), rms
