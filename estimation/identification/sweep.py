"""Mechanics from a drive whose frequency or amplitude changes: the equation of motion of the complex amplitude.

With theta = Im(Z exp(i w t)) and the torque Im(T exp(i w t)), w a constant near the strongest motion, the equation
J theta'' + b theta' + k theta = torque becomes ((i w + D)^2 + (i w + D) b/J + k/J) Z = T/J, D = d/dt. It is linear in
k/J, b/J and 1/J and holds in a transient, so that a sweep need not be slow against the decay time. All its coefficients
are constant, so that it also holds between averages of Z and T under one window, however fast the drive is swept: with
the rate of a swept reference in place of w, the average of a product would be taken for the product of the averages.

Under a drive of one frequency, a drift of k/J by a thousandth changes Z as much as a transient does, and would be taken
for an inertia that is wrong by a quarter. There only the part of the equation at a right angle to Z is used, the
balance of power, which holds for any k/J; k/J is its average over the record.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimation.identification.agreement import (
    Differences,
    IdentifiedValue,
    difference_by_extra_columns,
    linearly_independent,
)
from estimation.identification.fits import (
    check_driven_signs,
    drive_torque,
    torque_is_linear,
    values_from_ratios,
)
from estimation.identification.swept_record import SweptRecord, has_one_frequency
from estimation.least_squares import fit_linear
from scanner.arrays import Array, Complex, Mask
from scanner.device import Axis

WINDOW_CYCLES = 8.0
"""Cycles of the squared Hann window that separates the motion from its harmonics and its mean: first zero at three
eighths of the frequency."""

HOPS_PER_WINDOW = 16
"""Points per window: the equation is taken at overlapping windows, whose dependence the covariance allows for."""

MIN_INVERSE_INERTIA_SDS = 3.0
"""Estimate of 1/J over its standard deviation from which J is reported: below, its interval includes infinity."""


def fit_swept(axis: Axis, records: Sequence[SweptRecord]) -> dict[str, IdentifiedValue]:
    """``J``, ``b``, ``k``, ``k_over_J`` and ``b_over_J`` from swept or transient motion.

    Args:
        axis: its drive and its capacitance set the torque; its mechanics are not used.

    Returns:
        Values by name; none if 1/J is not determined, as by one steady frequency.

    Raises:
        BadInput: as ``check_driven_signs``.
    """
    equations = [_equations(axis, record) for record in records]
    columns, target = (np.concatenate([getattr(each, part) for each in equations]) for part in ("columns", "target"))
    if len(target) < HOPS_PER_WINDOW or not columns[:, 1:].any(axis=0).all():
        return {}
    known = np.asarray(columns.any(axis=0))  # not k/J, where every record is a balance of power
    ratios = np.zeros(3)
    ratios[known], _ = fit_linear(*(np.concatenate([part.real, part.imag]) for part in (columns[:, known], target)))
    change = np.eye(3)[:, known]  # of all coefficients with the known ones
    if not known[0]:
        ratios[0], change[0] = _mean_stiffness(equations, ratios[1:])
    fitted = ratios
    ratios = fitted - change @ _noise_bias(equations, fitted, known)
    covariance = change @ _covariance(equations, ratios, known) @ change.T
    stiffness, _, inverse = ratios
    if not (stiffness > 0.0 and abs(inverse) > MIN_INVERSE_INERTIA_SDS * np.sqrt(covariance[2, 2])):
        return {}
    check_driven_signs(axis.name, ratios)
    if not torque_is_linear(axis):
        return values_from_ratios(ratios, covariance)
    differences = _amplitude_dependence(equations, fitted, known)
    return values_from_ratios(ratios, covariance, change @ differences.excess, float(differences.conflict.max()))


@dataclass(frozen=True)
class _Equations:
    """Equations of motion of one record between windowed averages.

    Attributes:
        motion: columns of k/J, b/J, 1/J and any further unknowns, shape (points, 3 or more), relative to the direction
            of Z in a balance of power.
        acceleration: the right-hand side, shape (points,), relative to the same direction.
        windows: of the angle, its velocity and its acceleration, each of shape (window,).
        hop: samples between two points.
        balance: whether only the balance of power is used, the imaginary part.
        torque_rate: derivative of the torque, shape (points,), the column of a delay over J.
    """

    motion: Complex
    acceleration: Complex
    windows: tuple[Complex, ...]
    hop: int
    balance: bool
    torque_rate: Complex

    @property
    def columns(self) -> Complex:
        """The columns that are used: without a real part in a balance of power, and so without k/J."""
        return np.asarray(1j * self.motion.imag, np.complex128) if self.balance else self.motion

    @property
    def target(self) -> Complex:
        """The right-hand side that is used."""
        return np.asarray(1j * self.acceleration.imag, np.complex128) if self.balance else self.acceleration


def _equations(axis: Axis, record: SweptRecord) -> _Equations:
    """The equations of a record at its overlapping windows."""
    rate = record.driven.rate
    hop = max(1, round(WINDOW_CYCLES * rate / record.reference.frequency / HOPS_PER_WINDOW))
    angle, torque = (values - values.mean() for values in (record.driven.angle, drive_torque(axis, record.driven)))
    w = 2.0 * np.pi * _strongest_frequency(angle, torque, rate)
    carrier = 2j * np.exp(-1j * w * (record.time - record.time[0]))
    angle, torque = angle * carrier, torque * carrier
    plain, first, second = _windows(hop, rate)
    windows = tuple(
        np.asarray(each, np.complex128)
        for each in (plain, 1j * w * plain + first, second + 2j * w * first - w**2 * plain)
    )
    z, velocity, acceleration = (_averaged(angle, window, hop) for window in windows)
    lag = record.delay  # what is slow against the carrier is delayed by its series
    late = np.exp(-1j * w * lag) * (plain - lag * first + 0.5 * lag**2 * second)
    torque_rate = _averaged(torque, np.exp(-1j * w * lag) * (1j * w * plain + first), hop)
    motion = np.stack([z, velocity, -_averaged(torque, late, hop)], axis=1)
    balance = has_one_frequency(record)
    if balance:
        direction = z.conj() / np.maximum(np.abs(z), np.finfo(float).tiny)
        motion, acceleration = direction[:, None] * motion, direction * acceleration
        motion[:, 0] = np.abs(z)
    return _Equations(motion, -acceleration, windows, hop, balance, torque_rate)


def _with_amplitude_laws(equations: Sequence[_Equations]) -> list[_Equations]:
    """The equations with two more columns: k/J and b/J that change with the square of the amplitude."""
    largest = max(float(np.max(np.abs(each.motion[:, 0]))) for each in equations)
    extended = []
    for each in equations:
        relative = (np.abs(each.motion[:, :1]) / largest) ** 2
        extended.append(replace(each, motion=np.column_stack([each.motion, relative * each.motion[:, :2]])))
    return extended


def fit_delay(axis: Axis, records: Sequence[SweptRecord]) -> IdentifiedValue | None:
    """Further delay [s] of the angle against the drive, fitted with k and b that may depend on the amplitude.

    Args:
        axis: its torque does not depend on the angle, or the error of that would be a delay.

    Returns:
        None where it is not distinguished from the mechanics, as by one frequency.
    """
    equations = [_equations(axis, record) for record in records]
    if not torque_is_linear(axis) or any(each.balance for each in equations):
        return None
    extended = [
        replace(each, motion=np.column_stack([each.motion, each.torque_rate]))
        for each in _with_amplitude_laws(equations)
    ]
    columns, target = (np.concatenate([getattr(each, part) for each in extended]) for part in ("columns", "target"))
    together = np.concatenate([columns.real, columns.imag])
    if len(target) < HOPS_PER_WINDOW or not linearly_independent(together):
        return None
    ratios, _ = fit_linear(together, np.concatenate([target.real, target.imag]))
    spread = _covariance(extended, ratios, np.ones(ratios.size, bool))
    inverse = float(ratios[2])
    return IdentifiedValue(float(ratios[-1]) / inverse, float(np.sqrt(spread[-1, -1])) / abs(inverse))


def _amplitude_dependence(equations: Sequence[_Equations], ratios: Array, known: Mask) -> Differences:
    """Changes of the p ``known`` coefficients if k/J and b/J may depend on the square of the amplitude, shape (p,).

    A cubic stiffness adds 3/4 k3 |Z|^2 Z / J to the equation of motion, a damping by the squared angle a part of
    |Z|^2 DZ.
    """
    extended = _with_amplitude_laws(equations)
    columns, target = (np.concatenate([getattr(each, part) for each in extended]) for part in ("columns", "target"))
    used = np.asarray(columns.any(axis=0))
    used[:3] &= known
    together = np.concatenate([columns.real, columns.imag])[:, used]
    count = int(known.sum())
    if not linearly_independent(together):
        return Differences(np.zeros(count), np.zeros(count))
    coefficients = np.zeros(5)
    residual = np.concatenate([target.real, target.imag])
    coefficients[used], _ = fit_linear(together, residual)
    spread = _covariance(extended, coefficients, used)[count:, count:]
    columns, extra = together[:, :count], together[:, count:]
    return difference_by_extra_columns(columns, extra, residual - columns @ ratios[known], spread)


def _mean_stiffness(equations: Sequence[_Equations], others: Array) -> tuple[float, Array]:
    """k/J as an average with the weight |Z|^2, and its derivatives by b/J and 1/J, shape (2,)."""
    motion, target = (
        np.concatenate([getattr(each, part).real for each in equations]) for part in ("motion", "acceleration")
    )
    mean = motion[:, 0] @ np.column_stack([target, motion[:, 1:]]) / (motion[:, 0] @ motion[:, 0])
    return float(mean[0] - mean[1:] @ others), -mean[1:]


def _strongest_frequency(angle: Array, torque: Array, rate: float) -> float:
    """Frequency of the strongest motion among those at which a torque acts: mean with the power there [Hz]."""
    from scipy.fft import rfft

    power = np.abs(rfft(angle) * rfft(torque)) ** 2
    return float(np.average(np.arange(power.size) * (rate / angle.size), weights=power))


def _covariance(equations: Sequence[_Equations], ratios: Array, known: Mask) -> Array:
    """Covariance of the p ``known`` coefficients, shape (p, p).

    The residual is the noise of the angle, filtered by the equation of motion, which is least at the resonance, where
    the motion is: residuals of overlapping windows compensate each other there. The noise is taken as white within the
    windows' band; then the filter determines the correlation of the residuals, and only the noise's variance, one for
    each record, is estimated from them.
    """
    scaled, size, inverse = _scaled_columns(equations, known)
    spread = np.zeros((size.size, size.size))
    for each, columns in zip(equations, scaled, strict=True):
        spread += _between(each, ratios, columns) * _residual_variance(each, ratios, columns, inverse)
    return np.asarray(inverse @ spread @ inverse / np.outer(size, size))


def _noise_bias(equations: Sequence[_Equations], ratios: Array, known: Mask) -> Array:
    """Bias of the p ``known`` coefficients by the noise in their columns, to first order, shape (p,).

    The noise of the angle is in the columns and in the residual. Their covariance is that of the windows under white
    noise of the variance that the residual shows. In a balance of power it also turns the direction of Z, and with it
    the torque. With a Q of 8 and noise of an eighth of the signal, b/J of a motion in steps was 18 % too small.
    """
    scaled, size, inverse = _scaled_columns(equations, known)
    bias = np.zeros(size.size)
    for each, columns in zip(equations, scaled, strict=True):
        angle, velocity, _ = each.windows
        response = _response(each, ratios)
        common = np.array([np.vdot(window, response).real for window in (angle, velocity)])
        common *= _residual_variance(each, ratios, columns, inverse) / np.vdot(response, response).real
        moments = np.array([*(common * len(columns)), 0.0])
        if each.balance:  # half the power of complex noise is in the imaginary part
            turned = np.sum(each.motion[:, 2].real / each.motion[:, 0].real)
            moments = 0.5 * np.array([0.0, moments[1], -common[0] * turned])
        bias -= inverse @ (moments[known] / size)
    return np.asarray(bias / size)


def _scaled_columns(equations: Sequence[_Equations], known: Mask) -> tuple[list[Complex], Array, Array]:
    """The ``known`` columns of every record with an rms of 1, their rms, and the inverse of the normal matrix."""
    used = [each.columns[:, known] for each in equations]
    size = np.sqrt(np.mean(np.abs(np.concatenate(used)) ** 2, axis=0))
    scaled = [columns / size for columns in used]
    normal = sum(((columns.conj().T @ columns).real for columns in scaled), np.zeros((size.size, size.size)))
    return scaled, size, np.linalg.inv(normal)


def _between(equations: _Equations, ratios: Array, columns: Complex) -> Array:
    """Covariance of the moments of the columns of one record with a residual of variance 1, shape (p, p)."""
    correlated = _smoothed(columns, _residual_correlation(equations, ratios), "same")
    return np.asarray(0.5 * (columns.conj().T @ correlated).real)  # half the power of complex noise is in the real part


def _residual_variance(equations: _Equations, ratios: Array, columns: Complex, inverse: Array) -> float:
    """Variance of the residual of one record, from its part near the resonance.

    The residual is averaged under one more window, because most of its power is at the edges of the windows' band,
    where the noise may have another level. The expected share that the fit absorbs is allowed for.

    Args:
        columns: scaled. inverse: of the normal matrix.
    """
    weights = np.hanning(HOPS_PER_WINDOW + 2)[1:-1]
    residual = _smoothed((equations.target - equations.columns @ ratios)[:, None], weights, "valid")
    parts = 0.5 if equations.balance else 1.0  # of the power of complex noise
    narrow = _smoothed(columns, weights, "valid")
    correlation = _residual_correlation(equations, ratios)
    correlated = _smoothed(_smoothed(columns, correlation, "same"), weights, "valid")
    power = float(np.sum(np.convolve(weights, weights) * correlation[1:-1]).real)
    absorbed = np.trace(inverse @ (correlated.conj().T @ narrow).real)
    absorbed -= np.trace(inverse @ (narrow.conj().T @ narrow).real @ inverse @ _between(equations, ratios, columns))
    return float(np.sum(np.abs(residual) ** 2) / (parts * len(residual) * power - absorbed))


def _smoothed(values: Complex, weights: Complex | Array, mode: str) -> Complex:
    """Convolution of every column, shape (points, columns), with weights over time."""
    from scipy.signal import fftconvolve

    return np.asarray(fftconvolve(values, weights[:, None], mode=mode, axes=0), np.complex128)


def _residual_correlation(equations: _Equations, ratios: Array) -> Complex:
    """Autocorrelation of the residual of white noise at the lags from -HOPS_PER_WINDOW to HOPS_PER_WINDOW points."""
    from scipy.signal import fftconvolve

    response = _response(equations, ratios)
    correlation = fftconvolve(response, response.conj()[::-1])[:: equations.hop]
    return np.asarray(correlation / correlation[HOPS_PER_WINDOW].real, np.complex128)


def _response(equations: _Equations, ratios: Array) -> Complex:
    """Weights of the noise of the angle in the residual of one window, shape (window,)."""
    angle, velocity, acceleration = equations.windows
    return acceleration + ratios[1] * velocity + ratios[0] * angle


def _windows(hop: int, rate: float) -> tuple[Array, Array, Array]:
    """Squared Hann window of ``HOPS_PER_WINDOW`` hops and its first and second derivative in time, of the sum 1.

    The average under a derivative of the window is the derivative of the average under the window, because the window
    and its first derivative are 0 at both ends. The second derivative is so too: sums then equal the integrals also of
    the line at -2 w, which has few samples a period. Under a Hann window b/J is 0.3 % wrong at six samples a period.
    """
    size = HOPS_PER_WINDOW * hop
    turn = 2.0 * np.pi * np.arange(size + 1) / size
    w = 2.0 * np.pi * rate / size
    window = 1.5 - 2.0 * np.cos(turn) + 0.5 * np.cos(2.0 * turn)
    first = w * (2.0 * np.sin(turn) - np.sin(2.0 * turn))
    second = w**2 * (2.0 * np.cos(turn) - 2.0 * np.cos(2.0 * turn))
    return tuple(each / (1.5 * size) for each in (window, first, second))  # type: ignore[return-value]


def _averaged(values: Array | Complex, window: Array | Complex, hop: int) -> Complex:
    """Averages under a window, one every ``hop`` samples."""
    from scipy.signal import oaconvolve

    return np.asarray(oaconvolve(values, window, mode="valid")[::hop], np.complex128)
