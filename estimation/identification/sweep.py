"""Mechanics from a drive whose frequency or amplitude changes: the equation of motion of the complex amplitude.

With theta = Im(Z exp(i w t)) and the torque Im(T exp(i w t)), w a constant near the strongest motion, the equation
J theta'' + b theta' + k theta = torque becomes ((i w + D)^2 + (i w + D) b/J + k/J) Z = T/J, D = d/dt. It is linear in
k/J, b/J and 1/J and holds in a transient, so that a sweep need not be slow against the decay time. All its coefficients
are constant, so that it also holds between averages of Z and T under one window, however fast the drive is swept: with
the rate of a swept reference in place of w, the average of a product would be taken for the product of the averages.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from estimation.identification.fits import DrivenRecord, IdentifiedValue, drive_torque, values_from_ratios
from estimation.least_squares import fit_linear
from estimation.reference import PhaseReference
from scanner.arrays import Array, Complex
from scanner.device import Axis

WINDOW_CYCLES = 8.0
"""Cycles of the Hann window that separates the motion from its harmonics and its mean: first zero at a quarter of the
frequency."""

HOPS_PER_WINDOW = 16
"""Points per window: the equation is taken at overlapping windows, whose dependence the covariance allows for."""

MIN_INVERSE_INERTIA_SDS = 3.0
"""Estimate of 1/J over its standard deviation from which J is reported: below, its interval includes infinity."""


@dataclass(frozen=True)
class LockInOutput:
    """Amplitude and phase of a motion behind a lock-in amplifier.

    Attributes:
        time: shape (m,) [s].
        values: amplitude exp(i phase), shape (m,) [rad].
        turn: phase of the reference at given times [rad].
        frequency: mean frequency of the reference [Hz].
    """

    time: Array
    values: Complex
    turn: Callable[[Array], Array]
    frequency: float


@dataclass(frozen=True)
class SweptRecord:
    """Driven motion of any frequency and amplitude.

    Attributes:
        driven: angle and drive voltage.
        time: of its samples, shape (n,) [s].
        reference: phase of the motion's drive.
        lock_in: what a lock-in amplifier recorded, where the angle is interpolated from that.
    """

    driven: DrivenRecord
    time: Array
    reference: PhaseReference
    lock_in: LockInOutput | None = None


def fit_swept(axis: Axis, records: Sequence[SweptRecord]) -> dict[str, IdentifiedValue]:
    """``J``, ``b``, ``k``, ``k_over_J`` and ``b_over_J`` from swept or transient motion.

    Args:
        axis: its drive and its capacitance set the torque; its mechanics are not used.

    Returns:
        Values by name; none if 1/J is not determined, as by one steady frequency.
    """
    equations = [_equations(axis, record) for record in records]
    columns, target = (np.concatenate([getattr(each, part) for each in equations]) for part in ("columns", "target"))
    if len(target) < HOPS_PER_WINDOW or not columns.any(axis=0).all():
        return {}
    ratios, _ = fit_linear(*(np.concatenate([part.real, part.imag]) for part in (columns, target)))
    covariance = _covariance(equations, ratios)
    stiffness, _, inverse = ratios
    if not (stiffness > 0.0 and inverse > MIN_INVERSE_INERTIA_SDS * np.sqrt(covariance[2, 2])):
        return {}
    return values_from_ratios(ratios, covariance)


@dataclass(frozen=True)
class _Equations:
    """Equations of motion of one record between windowed averages.

    Attributes:
        columns: of k/J, b/J and 1/J, shape (points, 3). target: right-hand side, shape (points,).
        windows: of the angle, its velocity and its acceleration, each of shape (window,).
        hop: samples between two points.
    """

    columns: Complex
    target: Complex
    windows: tuple[Complex, ...]
    hop: int


def _equations(axis: Axis, record: SweptRecord) -> _Equations:
    """The equations of a record at its overlapping windows."""
    rate = record.driven.rate
    hop = max(1, round(WINDOW_CYCLES * rate / record.reference.frequency / HOPS_PER_WINDOW))
    w = 2.0 * np.pi * _strongest_frequency(record, hop)
    carrier = 2j * np.exp(-1j * w * (record.time - record.time[0]))
    angle, torque = (
        (values - values.mean()) * carrier for values in (record.driven.angle, drive_torque(axis, record.driven))
    )
    hann, first, second = _windows(hop, rate)
    windows = tuple(
        np.asarray(each, np.complex128) for each in (hann, 1j * w * hann + first, second + 2j * w * first - w**2 * hann)
    )
    z, velocity, acceleration = (_averaged(angle, window, hop) for window in windows)
    columns = np.stack([z, velocity, -_averaged(torque, hann, hop)], axis=1)
    return _Equations(columns, -acceleration, windows, hop)


def _strongest_frequency(record: SweptRecord, hop: int) -> float:
    """Mean frequency of the reference, weighted with the square of the motion's amplitude [Hz]."""
    psi = record.reference.phase(record.time)
    window = _windows(hop, record.driven.rate)[0]
    power = np.abs(_averaged(2j * (record.driven.angle - record.driven.angle.mean()) * np.exp(-1j * psi), window, hop))
    rate = _averaged(np.gradient(psi) * record.driven.rate / (2.0 * np.pi), window, hop).real
    return float(np.average(rate, weights=power**2))


def _covariance(equations: Sequence[_Equations], ratios: Array) -> Array:
    """Covariance of the coefficients, shape (3, 3).

    The residual is the noise of the angle, filtered by the equation of motion, which is least at the resonance, where
    the motion is: residuals of overlapping windows compensate each other there. The noise is taken as white within the
    windows' band; then the filter determines the correlation of the residuals, and only the noise's variance, one for
    each record, is estimated from them.
    """
    size = np.sqrt(np.mean(np.abs(np.concatenate([each.columns for each in equations])) ** 2, axis=0))
    scaled = [each.columns / size for each in equations]
    inverse = np.linalg.inv(sum(((columns.conj().T @ columns).real for columns in scaled), np.zeros((3, 3))))
    spread = np.zeros((3, 3))
    for each, columns in zip(equations, scaled, strict=True):
        correlation = _residual_correlation(each, ratios)
        correlated = _smoothed(columns, correlation, "same")
        between = 0.5 * (columns.conj().T @ correlated).real  # half the power of complex noise is in the real part
        spread += between * _residual_variance(each, ratios, columns, correlation, inverse, between)
    return np.asarray(inverse @ spread @ inverse / np.outer(size, size))


def _residual_variance(
    equations: _Equations, ratios: Array, columns: Complex, correlation: Complex, inverse: Array, between: Array
) -> float:
    """Variance of the residual of one record, from its part near the resonance.

    The residual is averaged under one more window, because most of its power is at the edges of the windows' band,
    where the noise may have another level. The expected share that the fit absorbs is allowed for.

    Args:
        columns: scaled. correlation: of the residual. inverse: of the normal matrix. between: covariance of the
            moments of the columns with a residual of variance 1.
    """
    weights = np.hanning(HOPS_PER_WINDOW + 2)[1:-1]
    residual = _smoothed((equations.target - equations.columns @ ratios)[:, None], weights, "valid")
    narrow = _smoothed(columns, weights, "valid")
    correlated = _smoothed(_smoothed(columns, correlation, "same"), weights, "valid")
    power = float(np.sum(np.convolve(weights, weights) * correlation[1:-1]).real)
    absorbed = np.trace(inverse @ (correlated.conj().T @ narrow).real)
    absorbed -= np.trace(inverse @ (narrow.conj().T @ narrow).real @ inverse @ between)
    return float(np.sum(np.abs(residual) ** 2) / (len(residual) * power - absorbed))


def _smoothed(values: Complex, weights: Complex | Array, mode: str) -> Complex:
    """Convolution of every column, shape (points, columns), with weights over time."""
    from scipy.signal import fftconvolve

    return np.asarray(fftconvolve(values, weights[:, None], mode=mode, axes=0), np.complex128)


def _residual_correlation(equations: _Equations, ratios: Array) -> Complex:
    """Autocorrelation of the residual of white noise at the lags from -HOPS_PER_WINDOW to HOPS_PER_WINDOW points."""
    from scipy.signal import fftconvolve

    angle, velocity, acceleration = equations.windows
    response = acceleration + ratios[1] * velocity + ratios[0] * angle
    correlation = fftconvolve(response, response.conj()[::-1])[:: equations.hop]
    return np.asarray(correlation / correlation[HOPS_PER_WINDOW].real, np.complex128)


def _windows(hop: int, rate: float) -> tuple[Array, Array, Array]:
    """Hann window of ``HOPS_PER_WINDOW`` hops and its first and second derivative in time, of the sum 1.

    The average under a derivative of the window is the derivative of the average under the window, because the window
    and its first derivative are 0 at both ends.
    """
    size = HOPS_PER_WINDOW * hop
    turn = 2.0 * np.pi * np.arange(size + 1) / size
    w = 2.0 * np.pi * rate / size
    curved = w**2 * np.cos(turn)
    curved[[0, -1]] /= 2.0  # the trapezoidal rule, as the second derivative is not 0 at the ends
    return tuple(each / size for each in (1.0 - np.cos(turn), w * np.sin(turn), curved))  # type: ignore[return-value]


def _averaged(values: Array | Complex, window: Array | Complex, hop: int) -> Complex:
    """Averages under a window, one every ``hop`` samples."""
    from scipy.signal import oaconvolve

    return np.asarray(oaconvolve(values, window, mode="valid")[::hop], np.complex128)
