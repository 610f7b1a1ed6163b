"""The Gaussian comb capacitance and its derivatives (``scanner.laws``) from one exponential without a call.

A filter's step waits for its exponentials, one after the other. The library's is a call, around which every state and
covariance in a register has to be saved; this one is a table and a short polynomial (Tang, ACM TOMS 15, 144, 1989),
which the compiler puts among the rest of the step. What does not wait for the angle is written so that it need not.
"""

from __future__ import annotations

import numpy as np
from numba import njit

FINE = 8.0  # v = FINE u; the table steps by 1 in v^2, 1/64 of the exponent, so that |r| <= 1/128
TABLE = np.exp(-np.arange(40.0 * FINE**2) / FINE**2)  # to 4e-18
ROUNDER = 1.5 * 2.0**52  # added to a number, leaves it rounded to an integer, which then stands in the lowest bits
ROUNDER_BITS = int(np.float64(ROUNDER).view(np.int64))
C1, C2, C3, C4, C5 = (1.0 / (n * FINE ** (2 * k)) for k, n in enumerate((1, 2, 6, 24, 120), start=1))  # of exp(r/64)


@njit(cache=True, error_model="numpy", fastmath={"contract"}, forceinline=True)
def gaussian(v):  # type: ignore[no-untyped-def]
    """exp(-(v/FINE)^2) of a float64 to 1e-15 of itself; 0 where that is below 4e-18, NaN for what is not finite."""
    rounded = v * v + ROUNDER
    entry = np.uint64(np.float64(rounded).view(np.int64) - ROUNDER_BITS)
    if entry >= TABLE.size:
        return 0.0 * v
    r = (rounded - ROUNDER) - v * v
    height, square = TABLE[entry], r * r
    return (height + height * (C1 * r)) + (height * square) * ((C2 + C3 * r) + square * (C4 + C5 * r))


@njit(cache=True, error_model="numpy", fastmath={"contract"}, forceinline=True)
def bell(theta, C0, Cb, narrow, theta_th):  # type: ignore[no-untyped-def]
    """Capacitance C0 exp(-u^2) + Cb [F], u = narrow (theta - theta_th), and its first two derivatives [F/rad, F/rad2].

    Args:
        narrow: 1/theta0 [1/rad].
    """
    v = (FINE * narrow) * theta - (FINE * narrow * theta_th)
    height = gaussian(v)
    slope = (-2.0 / FINE * C0 * narrow) * v
    curvature = (4.0 / FINE**2 * C0 * narrow * narrow) * (v * v) - 2.0 * C0 * narrow * narrow
    return C0 * height + Cb, slope * height, curvature * height
