"""Elementary functions for the integrator and the laws that it evaluates.

They call no library function, so the compiler evaluates them in several lanes of the processor's vectors at once. They
are no compiled functions of their own (``njit``): those have another identity in every process, and a law that calls
one is compiled anew in every process.
"""

from __future__ import annotations

import math
from math import factorial

import numpy as np
from numba.extending import register_jitable

_MIN_EXPONENT = -700.0
"""Exponents below are taken as this: exp(-700) = 1e-304 is negligible against any capacitance and still a normal
number."""

_LN2_HIGH, _LN2_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10
"""ln 2 in two parts. The last bits of the first are zero, so its product with an exponent is exact (Cody & Waite)."""

_ROUNDER = 1.5 * 2.0**52
"""Adding this to a number rounds it to an integer, which is then in the lowest bits of the sum."""

_ROUNDER_BITS = int(np.float64(_ROUNDER).view(np.int64))

C2, C3, C4, C5, C6, C7, C8, C9, C10, C11, C12, C13 = (1.0 / factorial(n) for n in range(2, 14))
# Taylor coefficients of exp; the first one left out is below 1e-17 for |r| <= ln(2) / 2.

S3, S5, S7, S9, S11, S13, S15 = ((-1.0) ** (n // 2) / factorial(n) for n in range(3, 16, 2))
# Taylor coefficients of the sine; the first one left out is below 1e-11 up to a quarter of a turn.


@register_jitable(forceinline=True, error_model="numpy", fastmath={"contract"})
def negative_exponential(x):  # type: ignore[no-untyped-def]
    """Return exp(x) for x <= 0 with a relative error of 3e-16, and 1e-304 below x = -700."""
    x = x if x > _MIN_EXPONENT else _MIN_EXPONENT
    rounded = x * (1.0 / (_LN2_HIGH + _LN2_LOW)) + _ROUNDER
    k = rounded - _ROUNDER
    r = (x - k * _LN2_HIGH) - k * _LN2_LOW
    r2 = r * r
    r4 = r2 * r2
    low = (C2 + r * C3) + r2 * (C4 + r * C5)
    middle = (C6 + r * C7) + r2 * (C8 + r * C9)
    high = (C10 + r * C11) + r2 * (C12 + r * C13)
    p = 1.0 + r * (1.0 + r * (low + r4 * (middle + r4 * high)))
    power = np.int64((np.float64(rounded).view(np.int64) - _ROUNDER_BITS + 1023) << 52)  # the bits of 2^k
    return p * power.view(np.float64)


@register_jitable(forceinline=True, error_model="numpy", fastmath={"contract"})
def cosine_of_half_turns(x):  # type: ignore[no-untyped-def]
    """Return cos(pi x) with an error of 1e-11, as the sine of the distance from the nearest zero."""
    turns = 0.5 * x + _ROUNDER
    u = math.pi * (0.5 - abs(x - 2.0 * (turns - _ROUNDER)))
    z = u * u
    return u * (1.0 + z * (S3 + z * (S5 + z * (S7 + z * (S9 + z * (S11 + z * (S13 + z * S15)))))))
