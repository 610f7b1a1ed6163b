"""Resampling of recorded channels: drives onto the integration grid, outputs to a lower rate."""

from __future__ import annotations

import numpy as np

from scanner.arrays import Array
from scanner.interpolation import interpolate_cubic


def resample_drive(samples: Array, position: Array) -> Array:
    """Samples of a drive at fractional positions.

    Smooth signals are resampled within their band. Next to a jump the value of the last sample is kept, because cubic
    interpolation would ring around it. A jump is a step between two samples that exceeds a quarter of the whole range
    and ten times the neighbouring steps.

    Args:
        samples: shape (n,).
        position: in samples, equidistant, shape (m,).

    Returns:
        shape (m,).
    """
    nearest = np.rint(position)
    if np.abs(position - nearest).max() < 1e-6:
        return samples[np.clip(nearest.astype(np.intp), 0, samples.size - 1)]
    factor = round(1.0 / (position[1] - position[0])) if position.size > 1 else 1
    dense_index = position * factor
    if factor > 1 and np.abs(dense_index - np.rint(dense_index)).max() < 1e-4 and not has_jumps(samples):
        from scipy.signal import resample_poly

        mean = samples.mean()
        dense = resample_poly(samples - mean, factor, 1, window=("kaiser", 8.0)) + mean
        return dense[np.clip(np.rint(dense_index).astype(np.intp), 0, dense.size - 1)]
    base = np.clip(np.floor(position + 1e-9).astype(np.intp), 1, samples.size - 3)
    a, b, c, d = samples[base - 1], samples[base], samples[base + 1], samples[base + 2]
    steps = np.stack([np.abs(b - a), np.abs(c - b), np.abs(d - c)])
    largest, ordinary = steps.max(axis=0), np.median(steps, axis=0)
    jumps = (largest > 0.25 * np.ptp(samples)) & (largest > 10.0 * ordinary)
    last_values = samples[np.clip(np.floor(position + 1e-9).astype(np.intp), 0, samples.size - 1)]
    return np.where(jumps, last_values, interpolate_cubic(samples, position))


def has_jumps(samples: Array) -> bool:
    """Whether a signal of shape (n,) has jumps between which it changes little, as square waves and steps have."""
    steps = np.abs(np.diff(samples))
    return bool(steps.max() > 0.2 * np.ptp(samples) > 0.0 and steps.max() > 30.0 * np.median(steps))


def fast_transform_length(n: int) -> int:
    """Largest length up to ``n`` with a fast Fourier transform; less than 1 % shorter for long signals."""
    from scipy.fft import prev_fast_len

    return int(prev_fast_len(n, real=True))


def decimate(values: Array, factor: int, padding: str = "mean") -> Array:
    """Decimate by ``factor`` after a zero-phase low-pass, flat to 1e-5 in the lower 70 % of the new band.

    Args:
        padding: continuation beyond both ends, as in ``scipy.signal.resample_poly``; ``"line"`` has no step there.
    """
    from scipy.signal import firwin, resample_poly

    taps = firwin(32 * factor + 1, 0.9 / factor, window=("kaiser", 10.0))
    return np.asarray(resample_poly(values, 1, factor, window=taps, padtype=padding))
