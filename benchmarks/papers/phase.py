"""The phase of a motion in the two definitions of Table III: by timing of peaks, as in the paper, and demodulated."""

from __future__ import annotations

import numpy as np

from scanner.arrays import Array
from scanner.lock_in import block_length, block_phasors

BLOCK_CYCLES = 4.0
"""Cycles of a demodulation block: short against the phase's changes, long enough to average the noise."""


def peak_times(values: Array, rate: float, frequency: float) -> Array:
    """Times of the maxima of a sine-like signal [s]: a parabola through a sixteenth of a period each way.

    At 5 MHz a sample is 1.1 degrees of a 15.7 kHz motion. Without the parabola, rounding to samples alone would make an
    error of 0.32 degrees.
    """
    period = rate / frequency
    half = max(2, round(period / 16))
    first = half + int(np.argmax(values[half : half + round(period)]))
    offset = np.arange(-half, half + 1)
    estimated = []
    while first + half < values.size:
        reach = np.arange(max(first - half, half), min(first + half + 1, values.size - half))
        top = int(reach[np.argmax(values[reach])]) if reach.size else first
        for _ in range(2):  # repeated around the vertex, so that noise does not select the window
            top = int(np.clip(top, half, values.size - half - 1))
            bend, slope, _ = np.polyfit(offset, values[top - half : top + half + 1], 2)
            shift = -0.5 * slope / bend if bend < 0 else 0.0
            next_top = round(top + shift)
            if next_top == top or abs(shift) > half:
                break
            top = next_top
        estimated.append(top + float(np.clip(shift, -half, half)))
        first = round(estimated[-1] + period)
    return np.array(estimated) / rate


def peak_error_deg(estimate: Array, truth: Array, rate: float, frequency: float) -> Array:
    """Error of the phase shift by peak timing, every peak of the truth [deg of the motion].

    The phase shift is the time from the drive's prior peak to the angle's peak (chen2020 IV-B). The drive's peak is
    common to both, so the error is the difference of the peaks' times.
    """
    true, estimated = (peak_times(v, rate, frequency) for v in (truth, estimate))
    nearest = estimated[np.abs(estimated[:, None] - true[None, :]).argmin(axis=0)]
    period = 1.0 / frequency
    late = (nearest - true + period / 2) % period - period / 2
    return 360.0 * frequency * late


def demodulated_error_deg(estimate: Array, truth: Array, rate: float, frequency: float) -> Array:
    """Error of the demodulated phase, every four cycles [deg]."""
    block = block_length(frequency, rate, BLOCK_CYCLES)
    estimated, true = (block_phasors(v, rate, 0.0, frequency, block)[1] for v in (estimate, truth))
    return np.rad2deg(np.angle(estimated / true))


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
