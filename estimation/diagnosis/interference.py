"""Interfering tones: lines in the residual of a fit that are harmonics of neither motion nor drive."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import percentile_filter

from estimation.diagnosis.fit import Fit
from estimation.diagnosis.noise import near_lines, noise_psd, periodogram
from scanner.arrays import Array

LINE_DETECTION_RATIO = 30.0
"""Power of a bin over the noise around it from which it is a line. Noise exceeds it with probability exp(-30) per bin,
which is negligible among a million bins."""

MOTION_HARMONICS = 19
"""Harmonics of the motion that are not interference. Above it they lie below the noise of the sense channel."""

MIN_LINES_OF_BROAD_DRIVE = 50
"""Number of lines of a drive from which an interfering tone may coincide with one of them by chance. Then a line that
exceeds its neighbours in the residual also counts."""

NEIGHBOUR_BINS = 64
"""Bins on either side whose 90 % quantile a line among those of a broad drive must exceed."""


def strongest_foreign_line(fit: Fit) -> float | None:
    """Frequency [Hz] of the strongest line of a sense channel off the harmonics of motion and drive, or None.

    If the drive has many lines, a tone among them counts if there is no other. Hum counts too; the fit decides by its
    size whether it is noise or interference.
    """
    best = among = (0.0, 0.0)
    model = fit.model
    x = np.array(
        [
            0.0 if f.kind == "additive" and f.name != "offset" else value
            for f, value in zip(model.parameters, fit.x, strict=True)
        ]
    )
    for run, signals in zip(model.runs, model.outputs(x), strict=True):
        for output, signal in zip(run.outputs, signals, strict=True):
            if output.kind != "sense":
                continue
            rest = output.data - signal
            rest = rest[output.guard[0] : rest.size - output.guard[1]]
            power = periodogram(rest - rest.mean())[: output.bins]
            duration = rest.size * output.step
            frequency = np.arange(power.size) / duration
            motion = run.scales[output.axes[0]].rate / (2 * np.pi)
            lines = [*(motion * np.arange(1, MOTION_HARMONICS + 1)), *run.lines[output.axes[0]]]
            width = max(0.06 * motion, 4.0 / duration) if run.lines[output.axes[0]].size < 200 else 4.0 / duration
            ratio = power / noise_psd(rest, power.size, output.step, lines, width)[0]
            ratio[near_lines(frequency, lines, width) | (frequency < 2.5 / duration)] = 0.0
            best = max(best, _strongest(ratio, power, duration))
            if run.lines[output.axes[0]].size > MIN_LINES_OF_BROAD_DRIVE:
                ratio = power / percentile_filter(power, 90, 2 * NEIGHBOUR_BINS + 1)
                ratio[
                    near_lines(frequency, lines[:MOTION_HARMONICS], 4.0 / duration) | (frequency < 2.5 / duration)
                ] = 0.0
                among = max(among, _strongest(ratio, power, duration))
    for height, line in (best, among):
        if height > LINE_DETECTION_RATIO:
            return line
    return None


def _strongest(ratio: Array, power: Array, duration: float) -> tuple[float, float]:
    """Largest ratio of a bin to the noise around it, and the frequency of that line [Hz]."""
    top = int(np.argmax(ratio))
    return float(ratio[top]), _peak(power, top) / duration


def _peak(power: Array, top: int) -> float:
    """Position of a peak in bins, from a parabola through the logarithms of three bins."""
    if not 0 < top < power.size - 1:
        return float(top)
    a, b, c = np.log(power[top - 1 : top + 2])
    return top + 0.5 * float((a - c) / (a - 2 * b + c))
