"""Lines in the spectrum of a drive: the strongest, all of them, and whether the drive is one steady tone."""

from __future__ import annotations

import numpy as np

from estimation.device_fit.noise import periodogram
from scanner.arrays import Array
from scanner.forward_model import DriveInput

STEADY_TONE_POWER_SHARE = 0.5
"""Share of the alternating power of a drive in a tone and its harmonics above which the drive counts as steady. Short
pulses reach a half; a sweep or noise has little power there."""

STEADY_TONE_HARMONICS = 6
"""Harmonics included in the power of a steady tone. For pulses of a twentieth of a period they hold half of the
power."""

LINE_SEARCH_SAMPLES = 1 << 17
"""Number of samples, from the start, in which the strongest line of a drive is searched. It bounds the cost of the
transform and resolves a line to 1/131 072 of the sample rate."""


def strongest_line(values: Array, rate: float) -> float:
    """Frequency of the strongest line of a signal of shape (n,) [Hz]; 0 for a constant signal.

    Args:
        rate: sample rate [Hz].
    """
    part = values[:LINE_SEARCH_SAMPLES]
    if part.std() < 1e-3 * (abs(part.mean()) + 1e-300):
        return 0.0
    return float(np.argmax(periodogram(part - part.mean())) * rate / part.size)


def is_steady(line: float, values: Array, rate: float) -> bool:
    """Whether a drive is a tone at ``line`` [Hz] with its harmonics, and not a sweep, a multisine or noise."""
    part = values[:LINE_SEARCH_SAMPLES]
    power, harmonic = periodogram(part - part.mean()), np.arange(1, STEADY_TONE_HARMONICS + 1)
    bins_from_line = np.abs(np.arange(power.size)[:, None] - harmonic * line * part.size / rate)
    half_widths = 2.0 + 0.5 * harmonic  # two bins of the window, and half a bin of error of the line
    in_tone = np.any(bins_from_line <= half_widths, axis=1)
    return bool(power[in_tone].sum() > STEADY_TONE_POWER_SHARE * power.sum())


def drive_lines(drive: DriveInput) -> Array:
    """Frequencies of the drive's lines [Hz]: above 1e-3 of the strongest, and well above their neighbours."""
    from scipy.ndimage import median_filter

    values = drive.voltage[:, 0] - drive.voltage[:, 0].mean()
    if values.std() < 1e-9 * (1.0 + np.abs(drive.voltage).max()):
        return np.empty(0)
    spectrum = np.abs(np.fft.rfft(values * np.hanning(values.size)))
    is_line = (spectrum > 1e-3 * spectrum.max()) & (spectrum > 6.0 * median_filter(spectrum, 41))
    return np.flatnonzero(is_line) / (values.size * drive.step)
