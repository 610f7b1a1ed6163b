"""The demodulator's first-order low-pass sections: their response and their exact step.

chen2020 (section II-C) treats their phase as a constant that calibration removes. Two sections near 41 kHz change the
phase of the sense signal by 0.0018 degrees a hertz at 31 kHz, so over the paper's sweep the phase is not constant.
Users of a readout therefore evaluate the response at the present frequency, or carry the sections as states.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from scanner.arrays import Array, Complex

SMALL_STEP = 0.05
"""Step in units of a section's time constant below which a series is used, because differences lose digits there."""


def lowpass_response(frequency: NDArray[Any] | float, cutoffs: Sequence[float]) -> Complex:
    """Return the complex gain of first-order sections in series, in the shape of ``frequency``.

    Args:
        frequency: [Hz].
        cutoffs: cut-off frequency of each section [Hz].
    """
    gain = np.ones(np.shape(frequency), dtype=np.complex128)
    for cutoff in cutoffs:
        gain = gain / (1.0 + 1j * np.asarray(frequency) / cutoff)
    return gain


def section_coefficients(cutoff: float, step: float) -> tuple[float, float, float]:
    """Return the coefficients of the exact step of u' = w (x - u) for an input that is linear between samples.

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


def curvature_share(cutoff: float, step: float) -> float:
    """Return the part of a second difference by which a parabola lies below its chord, as the section weighs it.

    It is the mean of s (1 - s) / 2 over one step with the weight exp(-a (1 - s)), a = 2 pi cutoff step: 1/12 for a
    cutoff far below the sampling rate, 1 / (2 a) far above, where the samples pass unchanged.
    """
    a = 2.0 * math.pi * cutoff * step
    if a < SMALL_STEP:
        return (1.0 - a * a / 60.0) / 12.0
    e, fall = math.exp(-a), -math.expm1(-a)
    first = (fall - a * e) / a
    second = (2.0 * fall - a * (a + 2.0) * e) / (a * a)
    return 0.5 * (first - second) / fall


@njit(cache=True, nogil=True)
def run_section(signal, e, p, q, u, x):  # type: ignore[no-untyped-def]
    """Filter ``signal`` (n,) in place, after an output ``u`` and an input ``x``. Returns the last output and input."""
    for i in range(signal.size):
        new = signal[i]
        u = e * u + p * x + q * new
        x = new
        signal[i] = u
    return u, x


def apply_lowpass(signal: Array, cutoff: float, step: float) -> Array:
    """Return a smooth signal after one first-order section that has settled at the signal's first value.

    The exact step is for an input that is linear between samples. Below its cutoff it attenuates a tone of angular
    frequency w by (w step)^2 / 12, which at a few tens of samples a cycle acts like an additional lag. Subtracting a
    part of the second differences first corrects for that, see :func:`curvature_share`.

    Args:
        signal: shape (n,).
        cutoff: cut-off frequency [Hz]. A negative one adds what a positive one of the same magnitude removes, so
            that a fit can pass through zero lag. An infinite one returns the signal itself.
        step: sampling interval [s].

    Returns:
        Shape (n,).
    """
    if not np.isfinite(cutoff):
        return signal
    filtered = _below_chord(signal, curvature_share(abs(cutoff), step))
    run_section(filtered, *section_coefficients(abs(cutoff), step), filtered[0], filtered[0])
    return filtered if cutoff > 0 else 2.0 * signal - filtered


@njit(cache=True, nogil=True)
def _below_chord(signal, share):  # type: ignore[no-untyped-def]
    """A signal of shape (n,) less ``share`` of its second differences, in one pass."""
    out = signal.copy()
    for i in range(1, signal.size - 1):
        out[i] -= share * (signal[i + 1] - 2.0 * signal[i] + signal[i - 1])
    return out
