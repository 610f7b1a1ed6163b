"""Inverse of a detector's first-order low-pass, as a short filter.

With the time constant tau and the factor a = exp(-dt / tau) by which the detector's memory decays in a sampling
interval dt, a sample is s[i] = a s[i-1] + (1 - a) v[i]. Here v[i] is the mean of the light over the interval before the
sample, with its photon noise, which arises before the low-pass and is white. The inverse
v[i] = (s[i] - a s[i-1]) / (1 - a) is therefore exact, and its photon noise is that of a fast detector.

The beam moves during the interval. For light that is linear in between, v[i] = (1 - w) L[i] + w L[i-1] with the light L
at the samples and w near 1/2. This mean has nearly no signal at half the sampling rate, so its inverse is regularised:
the response B becomes ``conj(B) (1 + r) / (|B|^2 + r)``. With large r only the delay of the mean is corrected, and no
noise is amplified. r is the noise relative to the signal, as the recording's own spectrum shows it: a smooth scene has
no light at high frequencies that could be recovered.

Electronic noise arises after the low-pass. The first step multiplies its variance by (1 + a^2) / (1 - a)^2, which is 32
at 200 kHz and 5 MS/s. Whoever uses the inverse has to measure the noise in it.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.arrays import Array, Complex
from scanner.device import Device
from scanner.lowpass import section_coefficients
from scanner.optics import terms_on_channel

LAG = "detector-lag"
"""Name of the term that states a detector's low-pass."""

MIN_REGULARISATION = 0.1
"""Lower bound on the noise relative to the signal in the inverse of the mean over an interval. It bounds the gain of
that inverse at 1.7. At 100 photons a sample, pictures of sharp scenes with 0.03 have about the same error, and those
with 0.3 or 0.01 a larger one."""

AVERAGED_SAMPLES = 20.0
"""Samples that are averaged in a value of a picture, from its own and nearby pixels, where noise and signal of a sample
are equal. The number grows with the root of their ratio under a spectrum of the scene that falls with the fourth power
of the wave number. A sharp scene then has 0.1 at 100 photons a sample and 0.3 at 10, near its least errors."""

MAX_NOISE_OVER_SIGNAL = 1e6
"""Bound on the noise relative to the signal of a sample, for light without detail: nothing is amplified there."""

MEASURED_SAMPLES = 1 << 16
"""Samples whose spectrum is measured: a thousand segments determine its values to 3 %."""

FIRST_MEASURED = 4
"""Lowest frequency of the spectrum that is used, in inverse ``SPECTRUM_SAMPLES``: detail of a few samples."""

REACH = 10
"""Samples before and after each at which the regularised inverse is cut off, where it has fallen to 0.2 %."""

SPECTRUM_SAMPLES = 64
"""Length at which the regularised inverse is computed: it has vanished within it."""


def detector_corners(device: Device) -> list[float]:
    """Return the cut-off frequency of each low-pass of the device's detector [Hz]."""
    corners = (active.values[0] for active in terms_on_channel(device, "intensity") if active.term.effect == LAG)
    return [corner for corner in corners if corner > 0.0]


def measure_regularisation(signal: Array, corner: float, step: float) -> float:
    """Return the noise relative to the signal in a value of a picture, for the detail of a recording's light.

    The spectrum of the light over the interval is that of edges, in proportion to the inverse square of the frequency,
    times the response of the mean over an interval; photon noise is white, electronic noise is that after the inverse
    of the low-pass. Their powers are fitted to the measured spectrum. Noise and signal are compared at a quarter of the
    sampling rate.

    Args:
        signal: shape (n,) or (n, detectors).
        corner: cut-off frequency of the low-pass [Hz].
        step: sampling interval [s].
    """
    from scipy.optimize import nnls  # here because it takes 0.1 s to import

    if len(signal) <= SPECTRUM_SAMPLES:
        return MIN_REGULARISATION
    decay, _, _ = section_coefficients(corner, step)
    light = (signal[1:] - decay * signal[:-1]) / (1.0 - decay)
    count = len(light) // SPECTRUM_SAMPLES
    segments = np.moveaxis(light[: count * SPECTRUM_SAMPLES].reshape(count, SPECTRUM_SAMPLES, -1), 1, -1)
    segments = segments[np.isfinite(segments).all(axis=-1)]
    window = np.hanning(SPECTRUM_SAMPLES)
    spectra = np.fft.rfft((segments - segments.mean(axis=-1, keepdims=True)) * window)[:, FIRST_MEASURED:]
    power = np.mean(np.abs(spectra) ** 2, axis=0) if len(spectra) else np.zeros(1)
    if not power.all():
        return MIN_REGULARISATION
    frequency = np.fft.rfftfreq(SPECTRUM_SAMPLES)[FIRST_MEASURED:]
    detail, electronic = (0.25 / frequency) ** 2, np.abs(1.0 - decay * np.exp(-2j * math.pi * frequency)) ** 2
    terms = np.column_stack(
        [np.abs(_mean_response(corner, step, frequency)) ** 2 * detail, np.ones_like(frequency), electronic]
    )
    signal_power, photons, after = nnls(terms / power[:, None], np.ones_like(power))[0]
    noise = photons + after * (1.0 + decay**2)
    ratio = noise / max(signal_power, noise / MAX_NOISE_OVER_SIGNAL, 1e-300)
    return float(max(np.sqrt(ratio) / AVERAGED_SAMPLES, MIN_REGULARISATION))


def inverse_filter(corner: float, step: float, regularisation: float = MIN_REGULARISATION) -> Array:
    """Return the filter whose sample i, from 0 to 2 ``REACH`` + 1, weights the samples that are i - ``REACH`` earlier.

    Args:
        corner: cut-off frequency of the low-pass [Hz].
        step: sampling interval [s].
        regularisation: noise relative to the signal.
    """
    decay, _, _ = section_coefficients(corner, step)
    response = _mean_response(corner, step, np.fft.rfftfreq(SPECTRUM_SAMPLES))
    inverse = np.conj(response) * (1.0 + regularisation) / (np.abs(response) ** 2 + regularisation)
    weights = np.roll(np.fft.irfft(inverse), REACH)[: 2 * REACH + 1]
    return np.convolve(weights / weights.sum(), [1.0, -decay]) / (1.0 - decay)


def _mean_response(corner: float, step: float, frequency: NDArray[Any]) -> Complex:
    """Response of the mean of the light over an interval at frequencies in cycles per sample."""
    _, previous, new = section_coefficients(corner, step)
    return np.asarray((new + previous * np.exp(-2j * math.pi * frequency)) / (new + previous))


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
