"""The demodulator's first-order low-pass sections: their response and their exact step.

chen2020 calls their phase a constant that calibration removes (section II-C). Two sections near 41 kHz turn the
sense signal by 0.0018 degrees a hertz at 31 kHz, so over the paper's sweep it is not: every user of a readout asks
for the response at the frequency of the moment, or carries the sections as states.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray


def response(frequency: NDArray[Any] | float, cutoffs: Sequence[float]) -> NDArray[np.complex128]:
    """Complex gain at ``frequency`` [Hz] of first-order sections in series, cut-offs [Hz]. Same shape as frequency."""
    gain = np.ones(np.shape(frequency), dtype=np.complex128)
    for cutoff in cutoffs:
        gain = gain / (1.0 + 1j * np.asarray(frequency) / cutoff)
    return gain


def step_coefficients(cutoff: float, step: float) -> tuple[float, float, float]:
    """Exact step of u' = w (x - u) for an input that is linear between samples.

    Args:
        cutoff: w / 2 pi [Hz].
        step: sampling interval [s].

    Returns:
        (e, p, q) of u1 = e u0 + p x0 + q x1.
    """
    a = 2.0 * math.pi * cutoff * step
    e = math.exp(-a)
    mean = -math.expm1(-a) / a
    return e, mean - e, 1.0 - mean


@njit(cache=True)
def lowpass(signal, e, p, q, u, x):  # type: ignore[no-untyped-def]
    """Run one section over ``signal`` (n,) in place, from output ``u`` and last input ``x``; returns the new two."""
    for i in range(signal.size):
        new = signal[i]
        u = e * u + p * x + q * new
        x = new
        signal[i] = u
    return u, x


def low_passed(signal: NDArray[np.float64], cutoff: float, step: float) -> NDArray[np.float64]:
    """One section over samples ``step`` apart of a smooth signal (n,), settled at its first value.

    A step that is exact for an input linear in between weakens a tone w by (w step)^2 / 12, which at a few tens of
    samples a turn passes for a lag of its own. A twelfth of the second differences, taken off first, undoes it.
    """
    bent = signal.copy()
    bent[1:-1] -= (signal[2:] - 2.0 * signal[1:-1] + signal[:-2]) / 12.0
    lowpass(bent, *step_coefficients(cutoff, step), bent[0], bent[0])
    return bent
