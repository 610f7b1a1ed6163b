"""The Gaussian comb capacitance and its derivatives (``scanner.laws``), with an exponential that needs no call.

A filter's step waits for its exponentials. A call to the library's exponential makes the compiler save every state and
covariance element that is held in a register. The table and short polynomial here are inlined instead; whatever does
not depend on the angle is arranged so that it can be computed while the angle is not yet known.

Source: Tang, ACM Transactions on Mathematical Software 15, 144 (1989).
"""

from __future__ import annotations

import numpy as np
from numba import njit

TABLE_STEPS = 8.0
"""Scale of the table: with v = TABLE_STEPS u its entries lie 1 apart in v^2, which is 1/64 of the exponent u^2, so that
the polynomial's argument is at most 1/128 and five terms reach 1e-15."""

TABLE = np.exp(-np.arange(40.0 * TABLE_STEPS**2) / TABLE_STEPS**2)
"""exp(-u^2) down to 4e-18, where it no longer changes a sum with 1."""

ROUNDING_CONSTANT = 1.5 * 2.0**52
"""Adding this to a number rounds it to an integer, which is then in the lowest bits of the sum."""

ROUNDING_BITS = int(np.float64(ROUNDING_CONSTANT).view(np.int64))
"""Bits of ``ROUNDING_CONSTANT``."""

C1, C2, C3, C4, C5 = (1.0 / (n * TABLE_STEPS ** (2 * k)) for k, n in enumerate((1, 2, 6, 24, 120), start=1))
"""Taylor coefficients of exp(r / TABLE_STEPS^2)."""


@njit(cache=True, error_model="numpy", fastmath={"contract"}, forceinline=True)
def fast_gaussian(v):  # type: ignore[no-untyped-def]
    """exp(-(v / TABLE_STEPS)^2) of a float64, relative error 1e-15; 0 below 4e-18, NaN if v is not finite."""
    rounded = v * v + ROUNDING_CONSTANT
    entry = np.uint64(np.float64(rounded).view(np.int64) - ROUNDING_BITS)
    if entry >= TABLE.size:
        return 0.0 * v
    r = (rounded - ROUNDING_CONSTANT) - v * v
    height, square = TABLE[entry], r * r
    return (height + height * (C1 * r)) + (height * square) * ((C2 + C3 * r) + square * (C4 + C5 * r))


@njit(cache=True, error_model="numpy", fastmath={"contract"}, forceinline=True)
def gaussian_capacitance(theta, C0, Cb, inverse_theta0, theta_th):  # type: ignore[no-untyped-def]
    """Capacitance C0 exp(-u^2) + Cb with u = (theta - theta_th) / theta0, and its first two derivatives.

    Args:
        theta: [rad]. C0, Cb: [F]. inverse_theta0: 1 / theta0 [1/rad]. theta_th: [rad].

    Returns:
        [F], [F/rad], [F/rad2].
    """
    v = (TABLE_STEPS * inverse_theta0) * theta - (TABLE_STEPS * inverse_theta0 * theta_th)
    height = fast_gaussian(v)
    slope = (-2.0 / TABLE_STEPS * C0 * inverse_theta0) * v
    peak_curvature = 2.0 * C0 * inverse_theta0 * inverse_theta0
    curvature = (4.0 / TABLE_STEPS**2 * C0 * inverse_theta0 * inverse_theta0) * (v * v) - peak_curvature
    return C0 * height + Cb, slope * height, curvature * height
