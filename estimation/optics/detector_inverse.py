"""Inverse of a detector's first-order low-pass, as a short filter.

With the time constant tau and the factor a = exp(-dt / tau) by which the detector's memory decays in a sampling
interval dt, a sample is s[i] = a s[i-1] + (1 - a) v[i]. Here v[i] is the mean of the light over the interval before the
sample, with its photon noise, which arises before the low-pass and is white. The inverse
v[i] = (s[i] - a s[i-1]) / (1 - a) is therefore exact, and its photon noise is that of a fast detector.

The beam moves during the interval. For light that is linear in between, v[i] = (1 - w) L[i] + w L[i-1] with the light L
at the samples and w near 1/2. This mean has nearly no signal at half the sampling rate, so its inverse is regularised:
the response B becomes ``conj(B) (1 + r) / (|B|^2 + r)`` with r = ``REGULARISATION``.

Electronic noise arises after the low-pass. The first step multiplies its variance by (1 + a^2) / (1 - a)^2, which is 32
at 200 kHz and 5 MS/s. Whoever uses the inverse has to measure the noise in it.
"""

from __future__ import annotations

import math

import numpy as np

from scanner.arrays import Array
from scanner.device import Device
from scanner.lowpass import section_coefficients
from scanner.optics import terms_on_channel

LAG = "detector-lag"
"""Name of the term that states a detector's low-pass."""

REGULARISATION = 0.1
"""Noise relative to signal in the inverse of the mean over an interval. It bounds the gain of that inverse at 1.7. At
100 photons a sample, pictures with 0.03 have about the same error, and those with 0.3 or 0.01 a larger one."""

REACH = 10
"""Samples before and after each at which the regularised inverse is cut off, where it has fallen to 0.2 %."""

SPECTRUM_SAMPLES = 64
"""Length at which the regularised inverse is computed: it has vanished within it."""


def detector_corners(device: Device) -> list[float]:
    """Return the cut-off frequency of each low-pass of the device's detector [Hz]."""
    corners = (active.values[0] for active in terms_on_channel(device, "intensity") if active.term.effect == LAG)
    return [corner for corner in corners if corner > 0.0]


def inverse_filter(corner: float, step: float) -> Array:
    """Return the filter whose sample i, from 0 to 2 ``REACH`` + 1, weights the samples that are i - ``REACH`` earlier.

    Args:
        corner: cut-off frequency of the low-pass [Hz].
        step: sampling interval [s].
    """
    decay, previous, new = section_coefficients(corner, step)
    response = (new + previous * np.exp(-2j * math.pi * np.fft.rfftfreq(SPECTRUM_SAMPLES))) / (new + previous)
    inverse = np.conj(response) / (np.abs(response) ** 2 + REGULARISATION)
    weights = np.roll(np.fft.irfft(inverse), REACH)[: 2 * REACH + 1]
    return np.convolve(weights / weights.sum(), [1.0, -decay]) / (1.0 - decay)


def undo_low_pass(signal: Array, weights: Array) -> Array:
    """Return the light before the low-pass, without the samples that have too few others around them.

    Args:
        signal: shape (n,) or (n, detectors).
        weights: as :func:`inverse_filter` returns them.

    Returns:
        Shape (n - weights.size + 1,) or (n - weights.size + 1, detectors).
    """
    columns = signal.reshape(len(signal), -1).T
    light = [np.convolve(column, weights, "valid") for column in columns]
    return np.stack(light, axis=-1).reshape(-1, *signal.shape[1:])
