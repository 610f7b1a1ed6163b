"""Phase and amplitude from samples: least squares against a sine, block by block."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Phasors = NDArray[np.complex128]


def block_phasors(values: Array, rate: float, start: float, frequency: float, block: int) -> tuple[Array, Phasors]:
    """Amplitude and phase of ``values`` near ``frequency`` in consecutive blocks.

    Every block is fitted, under a Hann window, with an offset and a sine: values = c + Im(Z exp(2 pi i f (t - tc))), so
    that a signal A sin(Phi(t)) gives Z = A exp(i Phi(tc)) at the block's centre tc. The fit is exact for one pure sine
    whatever the block's length; the window keeps harmonics and slopes out.

    Args:
        values: shape (n,).
        rate: [Hz]. start: time of the first sample [s]. frequency: [Hz]. block: samples; a rest at the end is left.

    Returns:
        (centre times [s], Z), both of shape (n // block,).
    """
    count = values.size // block
    offset = (np.arange(block) - 0.5 * (block - 1)) / rate
    basis = np.stack([np.ones(block), np.sin(2 * np.pi * frequency * offset), np.cos(2 * np.pi * frequency * offset)])
    window = np.sin(np.pi * (np.arange(block) + 0.5) / block) ** 2
    weights = np.linalg.solve((basis * window) @ basis.T, basis * window)
    fitted = values[: count * block].reshape(count, block) @ weights.T
    centres = start + (np.arange(count) * block + 0.5 * (block - 1)) / rate
    return np.asarray(centres, np.float64), np.asarray(fitted[:, 1] + 1j * fitted[:, 2], np.complex128)


def block_length(frequency: float, rate: float, cycles: float) -> int:
    """Samples in a block of about ``cycles`` cycles."""
    return max(4, round(cycles * rate / frequency))


def unwrapped(phase: Array) -> Array:
    """Phase without jumps, each step continuing the slope before it, so that a frequency that runs away is followed."""
    bend = np.diff(np.diff(phase), prepend=0.0)
    slope = np.cumsum(bend - 2 * np.pi * np.round(bend / (2 * np.pi)))
    return np.concatenate([phase[:1], phase[0] + np.cumsum(slope)])
