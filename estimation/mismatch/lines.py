"""Lines in what a fit leaves: tones that follow neither the drive nor the motion."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import percentile_filter

from estimation.mismatch.fit import Fit
from estimation.mismatch.noise import near_lines, noise_psd, periodogram

Array = NDArray[np.float64]

SURE = 30.0
"""A bin this many times the noise around it is a line: exp(-30) of a million bins of noise is none."""

MULTIPLES = 19
"""Harmonics of the motion that are its own."""

CROWDED = 50
"""Lines of a drive from which a tone may fall among them by chance: its own stands out of what the others leave."""

AROUND = 64
"""Bins to either side that a line has to stand out of there."""


def strongest_foreign_line(fit: Fit) -> float | None:
    """Frequency of the strongest line in any sense channel that lies on no harmonic of motion or drive [Hz], else None.

    Where the drive has many lines of its own, one among them counts if there is no other. Hum counts too: whether it is
    noise or interference is decided by its size, in the fit.
    """
    best = among = (0.0, 0.0)
    model = fit.model
    x = np.array(
        [
            0.0 if f.kind == "additive" and f.name != "offset" else value
            for f, value in zip(model.free, fit.x, strict=True)
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
            lines = [*(motion * np.arange(1, MULTIPLES + 1)), *run.lines[output.axes[0]]]
            width = 0.06 * motion if run.lines[output.axes[0]].size < 200 else 4.0 / duration
            ratio = power / noise_psd(rest, power.size, output.step, lines, width)[0]
            ratio[near_lines(frequency, lines, width) | (frequency < 2.5 / duration)] = 0.0
            best = max(best, _strongest(ratio, power, duration))
            if run.lines[output.axes[0]].size > CROWDED:
                ratio = power / percentile_filter(power, 90, 2 * AROUND + 1)
                ratio[near_lines(frequency, lines[:MULTIPLES], 4.0 / duration) | (frequency < 2.5 / duration)] = 0.0
                among = max(among, _strongest(ratio, power, duration))
    for height, line in (best, among):
        if height > SURE:
            return line
    return None


def _strongest(ratio: Array, power: Array, duration: float) -> tuple[float, float]:
    """The largest ratio of a line to what is around it, and the line's frequency [Hz]."""
    top = int(np.argmax(ratio))
    return float(ratio[top]), _peak(power, top) / duration


def _peak(power: Array, top: int) -> float:
    """Position of a peak between bins, by a parabola through the logarithms of three."""
    if not 0 < top < power.size - 1:
        return float(top)
    a, b, c = np.log(power[top - 1 : top + 2])
    return top + 0.5 * float((a - c) / (a - 2 * b + c))
