"""Mechanics from a drive whose frequency or amplitude changes: the equation of motion of the complex amplitude.

With theta = Im(Z exp(i psi)) and the torque Im(T exp(i psi)), psi the phase of the reference and w its rate, the
equation J theta'' + b theta' + k theta = torque becomes ((i w + D)^2 + (i w + D) b/J + k/J) Z = T/J, D = d/dt. It is
linear in k/J, b/J and 1/J and holds in a transient, so that a sweep need not be slow against the decay time.
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
"""Points per window: the derivative D by central differences of fourth order is then exact to 1e-3 for everything that
passes the window."""

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
    psi = record.reference.phase(record.time)
    z, torque = (
        _complex_amplitude(values, psi, hop) for values in (record.driven.angle, drive_torque(axis, record.driven))
    )
    w = _smoothed(np.gradient(psi) * rate, hop)
    step = hop / rate
    first, second = _derivative(z, step), _derivative(_derivative(z, step), step)
    turn = _derivative(w, step)
    inner = slice(4, -4)
    velocity = (1j * w * z)[2:-2] + first
    acceleration = second + 2j * w[4:-4] * first[2:-2] + (1j * turn[2:-2] - w[4:-4] ** 2) * z[inner]
    columns = np.stack([z[inner], velocity[2:-2], -torque[inner]], axis=1)
    return columns, -acceleration


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


def _complex_amplitude(values: Array, psi: Array, hop: int) -> Complex:
    """Z of Im(Z exp(i psi)) averaged under Hann windows, one every ``hop`` samples."""
    mixed = 2j * (values - values.mean()) * np.exp(-1j * psi)
    return _smoothed(mixed.real, hop) + 1j * _smoothed(mixed.imag, hop)


def _smoothed(values: Array, hop: int) -> Array:
    """Hann-weighted means of ``HOPS_PER_WINDOW`` hops, one every ``hop`` samples."""
    from scipy.signal import oaconvolve

    window = np.hanning(HOPS_PER_WINDOW * hop + 1)
    return np.asarray(oaconvolve(values, window / window.sum(), mode="valid")[::hop])


def _derivative(values: Complex | Array, step: float) -> Complex:
    """Central differences of fourth order, two points shorter at either end."""
    return np.asarray((values[:-4] - 8 * values[1:-3] + 8 * values[3:-1] - values[4:]) / (12 * step))
