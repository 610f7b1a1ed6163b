"""The phase of a motion in the two definitions of Table III: by the timing of peaks (the paper's), and demodulated."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanner.demodulate import block_length, block_phasors

Array = NDArray[np.float64]

BLOCK_CYCLES = 4.0


def peak_times(values: Array, rate: float, frequency: float) -> Array:
    """Times of the maxima of a sine-like signal [s]: a parabola through a sixteenth of a period each way.

    At 5 MHz a sample is 1.1 degrees of a 15.7 kHz motion: without the parabola the clock alone would make 0.32 degrees.
    """
    period = rate / frequency
    half = max(2, round(period / 16))
    first = half + int(np.argmax(values[half : half + round(period)]))
    offset = np.arange(-half, half + 1)
    found = []
    while first + half < values.size:
        reach = np.arange(max(first - half, half), min(first + half + 1, values.size - half))
        top = int(reach[np.argmax(values[reach])]) if reach.size else first
        for _ in range(2):  # again about the found vertex, so that noise does not choose the window
            top = int(np.clip(top, half, values.size - half - 1))
            bend, slope, _ = np.polyfit(offset, values[top - half : top + half + 1], 2)
            shift = -0.5 * slope / bend if bend < 0 else 0.0
            moved = round(top + shift)
            if moved == top or abs(shift) > half:
                break
            top = moved
        found.append(top + float(np.clip(shift, -half, half)))
        first = round(found[-1] + period)
    return np.array(found) / rate


def peak_error_deg(estimate: Array, truth: Array, rate: float, frequency: float) -> Array:
    """Error of the phase shift by peak timing, every peak of the truth [deg of the motion].

    The phase shift is the time from the drive's prior peak to the angle's peak (chen2020 IV-B). The drive's peak is
    common to both, so the error is the difference of the peaks' times.
    """
    true, found = (peak_times(v, rate, frequency) for v in (truth, estimate))
    nearest = found[np.abs(found[:, None] - true[None, :]).argmin(axis=0)]
    period = 1.0 / frequency
    late = (nearest - true + period / 2) % period - period / 2
    return 360.0 * frequency * late


def demodulated_error_deg(estimate: Array, truth: Array, rate: float, frequency: float) -> Array:
    """Error of the demodulated phase, every four cycles [deg]."""
    block = block_length(frequency, rate, BLOCK_CYCLES)
    found, true = (block_phasors(v, rate, 0.0, frequency, block)[1] for v in (estimate, truth))
    return np.rad2deg(np.angle(found / true))


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
