"""Mechanics from swept or transient motion that a lock-in amplifier recorded as amplitude and phase.

The model of the recorded values is that of the instrument: the motion theta'' + b/J theta' + k/J theta = torque/J,
demodulated with the reference, filtered, and sampled at the times of the values. No recording states the filter, and
its delay alone, often several ms, would be read as damping. Therefore the filter is fitted too: a delay beyond that of
an impulse response with a standard deviation in time, whose shape is that of a cascade of equal low-passes of first
order (of 1 to 8, the orders of lock-in amplifiers) or Gaussian, as that of an average over a time. The order is the one
that leaves the least residual. A filter is linear in the frame of the reference, whose frequency may be swept.

Motion and filter are computed by Fourier transform within a band about the reference's mean frequency. 1/J and the
motion at the start are linear and eliminated.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np

from estimation.identification.agreement import IdentifiedValue
from estimation.identification.fits import drive_torque, values_from_ratios
from estimation.identification.sweep import MIN_INVERSE_INERTIA_SDS
from estimation.identification.swept_record import LockInOutput, SweptRecord
from scanner.arrays import Array, Complex
from scanner.device import Axis

FILTER_ORDERS = (1, 2, 4, 8, None)
"""Numbers of low-passes of first order that are tried; None: Gaussian. Orders between them differ little in shape."""

POINTS_PER_VALUE = 8.0
"""Points of the model for each recorded value: its cubic interpolation is then exact to 1e-4."""

MAX_BAND_FRACTION = 0.9
"""Half width of the band over its centre: it ends above zero, where the slow part of the torque is."""

PADDING_FRACTION = 0.125
"""Time after the end, over that of the recording. What wraps around is a free motion, which is eliminated."""

START_SD = 4.0
"""Values are used from this many standard deviations of the filter, and its delay, after the start: before, they depend
on the motion before the recording."""

STEPS = np.array([1e-7, 1e-4, 1e-3, 1e-3])
"""Steps of the numerical derivatives: of log k/J, log b/J, and of delay and width in times between two values."""


class LockInFit(NamedTuple):
    """Result of a fit.

    Attributes:
        values: ``J``, ``b``, ``k``, ``k_over_J`` and ``b_over_J``; none if 1/J is not determined.
        delay: of the filter's response in the mean [s]. width: standard deviation of that response in time [s].
    """

    values: dict[str, IdentifiedValue]
    delay: float
    width: float

    def describe(self) -> str:
        """The filter in words."""
        return (
            f"the filter of the lock-in amplifier is found with the mechanics: it delays by {1e3 * self.delay:.3g} ms "
            f"and averages over {1e3 * self.width:.3g} ms (standard deviation); the intervals include its uncertainty"
        )


def fit_lock_in_sweep(axis: Axis, record: SweptRecord, output: LockInOutput, start: tuple[float, float]) -> LockInFit:
    """Fit mechanics and filter.

    Args:
        axis: its drive and its capacitance set the torque; its mechanics are not used.
        record: of the same motion, for its drive. output: of the lock-in amplifier.
        start: k/J [1/s2] and b/J [1/s] from which the search begins.
    """
    from scipy.optimize import least_squares

    spacing = float(np.median(np.diff(output.time)))
    x = np.array([*np.log(start), 0.0, 1.0 / 12.0])
    bounds = ([x[0] - 1.0, x[1] - 5.0, -np.inf, 0.0], [x[0] + 1.0, x[1] + 5.0, np.inf, np.inf])
    model = _Model(drive_torque(axis, record.driven), record, output)
    order = FILTER_ORDERS[-1]
    for _ in range(2):
        found = []
        for each in FILTER_ORDERS:
            residual = partial(_residual, model, order=each)
            found.append((least_squares(residual, x, x_scale=[1e-3, 0.1, 1.0, 1.0], bounds=bounds), each))
        best, order = min(found, key=lambda each: each[0].cost)
        x = best.x
        model.use_after(float(record.time[0]) + spacing * (max(x[2], 0.0) + START_SD * np.sqrt(x[3])))
    return _conclude(model, x, order)


class _Model:
    """Recorded values by mechanics and filter, on a coarse clock."""

    def __init__(self, torque: Array, record: SweptRecord, output: LockInOutput):
        from scipy.fft import fft, next_fast_len

        rate, count, spacing = record.driven.rate, torque.size, float(np.median(np.diff(output.time)))
        size = next_fast_len(round(count * (1.0 + PADDING_FRACTION)))
        centre = round(output.frequency * size / rate)
        half_hz = min(0.5 * POINTS_PER_VALUE / spacing, MAX_BAND_FRACTION * output.frequency)
        half = max(1, min(round(half_hz * size / rate), size // 2 - centre))
        band = np.arange(centre - half, centre + half)
        step = size / rate / band.size
        self.output, self.spacing, self.size = output, spacing, band.size
        self.w = 2.0 * np.pi * band * rate / size
        recorded = (band * (rate / size / output.frequency)) ** output.order
        self.torque = fft(torque - torque.mean(), size)[band] * (2.0 / size) * recorded
        self.elapsed = np.arange(band.size) * step
        self.time = float(record.time[0]) + self.elapsed
        carrier = 2.0 * np.pi * centre * rate / size * self.elapsed
        self.frame = 1j * np.exp(-1j * output.turn(self.time))
        self.carrier = np.exp(1j * carrier)
        self.rate = 2j * np.pi * np.fft.fftfreq(band.size, step)
        self.used = np.ones(output.time.size, bool)

    def use_after(self, time: float) -> None:
        """Leave out the values before a time [s]."""
        self.used = self.output.time >= time

    def columns(self, x: Array, order: int | None) -> Complex:
        """Values for 1/J = 1 and for a free motion of amplitude 1 at the start, shape (m, 2)."""
        from scipy.fft import fft, ifft, ifftshift
        from scipy.interpolate import CubicSpline

        stiffness, loss = np.exp(x[:2])
        spectrum = self.torque / (stiffness - self.w**2 + 1j * self.w * loss)
        forced = ifft(ifftshift(spectrum)) * self.size * self.carrier
        free = np.exp((-0.5 * loss + 1j * np.sqrt(max(stiffness - 0.25 * loss**2, 0.0))) * self.elapsed)
        response = _filter_response(self.rate * self.spacing, x[2], x[3], order)
        seen = ifft(fft(np.stack([forced, free]) * self.frame, axis=1) * response, axis=1)
        return np.asarray(CubicSpline(self.time, seen, axis=1)(self.output.time[self.used]).T, np.complex128)

    def basis(self, x: Array, order: int | None) -> Array:
        """Columns of the linear unknowns, for the real and the imaginary parts of the values, shape (2 m, 3)."""
        forced, free = self.columns(x, order).T
        columns = np.stack([forced, free, 1j * free], axis=1)
        return np.concatenate([columns.real, columns.imag])

    def target(self) -> Array:
        """Real and imaginary parts of the values, shape (2 m,)."""
        values = self.output.values[self.used]
        return np.concatenate([values.real, values.imag])

    def noise_correlation(self, x: Array, order: int | None) -> Array:
        """Correlation of the values' noise at lags of 0 to m - 1: white noise before the filter, shape (m,)."""
        power = np.abs(_filter_response(self.rate * self.spacing, x[2], x[3], order)) ** 2
        lags = np.fft.ifft(power).real
        at = np.arange(self.used.sum()) * self.spacing
        return np.interp(at, self.elapsed[: self.size // 2], lags[: self.size // 2] / lags[0], right=0.0)


def _filter_response(rate: Complex, delay: float, variance: float, order: int | None) -> Complex:
    """Response of the filter at d/dt = ``rate``, both in times between two values, as delay and variance are."""
    if order is None:
        return np.asarray(np.exp(-delay * rate + 0.5 * variance * rate**2))
    lag = np.sqrt(variance / order) * rate
    return np.asarray(np.exp(-delay * rate + order * (lag - np.log1p(lag))))


def _solve(basis: Array, target: Array) -> Array:
    size = np.linalg.norm(basis, axis=0)
    return np.asarray(np.linalg.lstsq(basis / size, target, rcond=None)[0] / size)


def _residual(model: _Model, x: Array, order: int | None) -> Array:
    basis, target = model.basis(x, order), model.target()
    return np.asarray(target - basis @ _solve(basis, target))


def _measured_correlation(filtered: Array, residual: Complex) -> Array:
    """Correlation of a noise of which a part passed the filter and the rest was added after it, shape (m,).

    Args:
        filtered: correlation of the noise that passed the filter, by lag, shape (m,).
        residual: of which the share of that noise is estimated, shape (m,).
    """
    from scipy.signal import fftconvolve

    lags = fftconvolve(residual, residual[::-1].conj())[residual.size - 1 :].real
    after = filtered[1:] / (filtered[1:] @ filtered[1:] + np.finfo(float).tiny)
    share = float(np.clip(after @ lags[1:] / lags[0], 0.0, 1.0))
    return np.concatenate([[1.0], share * filtered[1:]])


def _conclude(model: _Model, x: Array, order: int | None) -> LockInFit:
    """Values and their covariance: that of least squares under the noise as its residual and the filter show it."""
    from scipy.signal import fftconvolve

    target, basis = model.target(), model.basis(x, order)
    linear = _solve(basis, target)
    slopes = []
    for k, step in enumerate(STEPS):
        above, below = x.copy(), x.copy()
        above[k] += step
        below[k] -= step if k < 3 or x[3] > step else 0.0
        slopes.append((model.basis(above, order) - model.basis(below, order)) @ linear / (above[k] - below[k]))
    jacobian = np.concatenate([np.stack(slopes, axis=1), basis], axis=1)
    size = np.linalg.norm(jacobian, axis=0)
    jacobian /= size
    inverse = np.linalg.pinv(jacobian.T @ jacobian)
    half = len(target) // 2
    residual = target - basis @ linear
    one_side = _measured_correlation(model.noise_correlation(x, order), residual[:half] + 1j * residual[half:])
    correlation = np.concatenate([one_side[:0:-1], one_side])[:, None]
    parts = (jacobian[:half], jacobian[half:])
    correlated = (fftconvolve(part, correlation, axes=0)[half - 1 : 2 * half - 1] for part in parts)
    between = sum((part.T @ each for part, each in zip(parts, correlated, strict=True)), np.zeros(inverse.shape))
    variance = float(residual @ residual) / (len(target) - float(np.trace(inverse @ between)))
    covariance = variance * inverse @ between @ inverse / np.outer(size, size)
    stiffness, loss = np.exp(x[:2])
    ratios = np.array([stiffness, loss, linear[0]])
    scale = np.array([stiffness, loss, 1.0])
    chosen = [0, 1, 4]
    spread = covariance[np.ix_(chosen, chosen)] * np.outer(scale, scale)
    determined = linear[0] > MIN_INVERSE_INERTIA_SDS * np.sqrt(spread[2, 2])
    return LockInFit(
        values_from_ratios(ratios, spread) if determined else {},
        float(x[2]) * model.spacing,
        float(np.sqrt(x[3])) * model.spacing,
    )
