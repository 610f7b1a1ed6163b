"""Mechanics from a drive whose frequency or amplitude changes: the equation of motion of the complex amplitude.

With theta = Im(Z exp(i w t)) and the torque Im(T exp(i w t)), w a constant near the strongest motion, the equation
J theta'' + b theta' + k theta = torque becomes ((i w + D)^2 + (i w + D) b/J + k/J) Z = T/J, D = d/dt. It is linear in
k/J, b/J and 1/J and holds in a transient, so that a sweep need not be slow against the decay time. All its coefficients
are constant, so that it also holds between averages of Z and T under one window, however fast the drive is swept: with
the rate of a swept reference in place of w, the average of a product would be taken for the product of the averages.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
class SweptRecord:
    """Driven motion of any frequency and amplitude.

    Attributes:
        driven: angle and drive voltage.
        time: of its samples, shape (n,) [s].
        reference: phase of the motion's drive.
    """

    driven: DrivenRecord
    time: Array
    reference: PhaseReference


def fit_swept(axis: Axis, records: Sequence[SweptRecord]) -> dict[str, IdentifiedValue]:
    """``J``, ``b``, ``k``, ``k_over_J`` and ``b_over_J`` from swept or transient motion.

    Args:
        axis: its drive and its capacitance set the torque; its mechanics are not used.

    Returns:
        Values by name; none if 1/J is not determined, as by one steady frequency.
    """
    equations = [_equations(axis, record) for record in records]
    columns, target = (np.concatenate(parts) for parts in zip(*equations, strict=True))
    if len(target) < HOPS_PER_WINDOW or not columns.any(axis=0).all():
        return {}
    ratios, _ = fit_linear(*(np.concatenate([part.real, part.imag]) for part in (columns, target)))
    covariance = _covariance(columns, target - columns @ ratios)
    stiffness, _, inverse = ratios
    if not (stiffness > 0.0 and inverse > MIN_INVERSE_INERTIA_SDS * np.sqrt(covariance[2, 2])):
        return {}
    return values_from_ratios(ratios, covariance)


def _equations(axis: Axis, record: SweptRecord) -> tuple[Complex, Complex]:
    """Columns of k/J, b/J and 1/J, shape (points, 3), and the right-hand side of the equation, shape (points,)."""
    rate = record.driven.rate
    hop = max(1, round(WINDOW_CYCLES * rate / record.reference.frequency / HOPS_PER_WINDOW))
    w = 2.0 * np.pi * _strongest_frequency(record, hop)
    carrier = 2j * np.exp(-1j * w * (record.time - record.time[0]))
    angle, torque = (
        (values - values.mean()) * carrier for values in (record.driven.angle, drive_torque(axis, record.driven))
    )
    windows = _windows(hop, rate)
    z, first, second = (_averaged(angle, window, hop) for window in windows)
    velocity, acceleration = 1j * w * z + first, second + 2j * w * first - w**2 * z
    return np.stack([z, velocity, -_averaged(torque, windows[0], hop)], axis=1), -acceleration


def _strongest_frequency(record: SweptRecord, hop: int) -> float:
    """Mean frequency of the reference, weighted with the square of the motion's amplitude [Hz]."""
    psi = record.reference.phase(record.time)
    window = _windows(hop, record.driven.rate)[0]
    power = np.abs(_averaged(2j * (record.driven.angle - record.driven.angle.mean()) * np.exp(-1j * psi), window, hop))
    rate = _averaged(np.gradient(psi) * record.driven.rate / (2.0 * np.pi), window, hop).real
    return float(np.average(rate, weights=power**2))


def _covariance(columns: Complex, residual: NDArray[Any]) -> Array:
    """Covariance of the coefficients where residuals of overlapping windows depend on each other, shape (3, 3).

    The sandwich estimate with Bartlett weights over one window (Newey and West, Econometrica 55, 703, 1987).
    """
    size = np.sqrt(np.mean(np.abs(columns) ** 2, axis=0))
    scaled = columns / size
    moments = (scaled.conj() * residual[:, None]).real
    spread = moments.T @ moments
    for lag in range(1, HOPS_PER_WINDOW):
        between = moments[lag:].T @ moments[:-lag]
        spread += (1.0 - lag / HOPS_PER_WINDOW) * (between + between.T)
    inverse = np.linalg.inv((scaled.conj().T @ scaled).real)
    return np.asarray(inverse @ spread @ inverse / np.outer(size, size))


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


def _averaged(values: Array | Complex, window: Array, hop: int) -> Complex:
    """Averages under a window, one every ``hop`` samples."""
    from scipy.signal import oaconvolve

    return np.asarray(oaconvolve(values, window, mode="valid")[::hop], np.complex128)
