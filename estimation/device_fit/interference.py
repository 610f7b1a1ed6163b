"""Interfering tones: lines in the residual of a fit that are harmonics of neither motion nor drive."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import percentile_filter

from estimation.device_fit.data import Run
from estimation.device_fit.fit import Fit, Likelihood
from estimation.device_fit.model import Model
from estimation.device_fit.noise import MEDIAN_TO_MEAN_POWER, near_lines, noise_psd, periodogram
from scanner.arrays import Array

LINE_DETECTION_RATIO = 30.0
"""Ratio of the power of a bin to the noise around it from which it is a line. Noise exceeds it with a probability of
exp(-30) per bin, which is negligible among a million bins."""

MOTION_HARMONICS = 19
"""Number of harmonics of the motion that are excluded from the search. Higher ones are weaker than the noise of the
sense channel."""

MIN_LINES_OF_BROAD_DRIVE = 50
"""Number of lines of a drive from which an interfering tone may coincide with one of them. Such a tone is searched
among the lines of the drive, as a line that exceeds its neighbours in the residual."""

MIN_LINES_OF_DENSE_DRIVE = 200
"""Number of lines of a drive from which only bins next to a line are excluded: wider intervals would leave none."""

NEIGHBOUR_BINS = 64
"""Bins on either side of a line that it has to exceed. Their median distinguishes it from a resonance of an amplifier,
which is narrower than a band of the noise spectrum; among the lines of a broad drive it is their 90 % quantile."""


@dataclass(frozen=True)
class _AxisLines:
    """Lines that an axis causes in a channel.

    Attributes:
        motion: harmonics of its motion, shape (h,) [Hz].
        drive: lines of its drive, shape (n,) [Hz].
        width: excluded on either side of each [Hz].
    """

    motion: Array
    drive: Array
    width: float

    @property
    def all(self) -> Array:
        return np.concatenate([self.motion, self.drive])

    @property
    def is_broad(self) -> bool:
        """Whether the drive has so many lines that a tone may coincide with one of them."""
        return self.drive.size > MIN_LINES_OF_BROAD_DRIVE

    def without_broad_drive(self, width: float) -> _AxisLines:
        """Harmonics of the motion alone, with another width, where the drive is broad; else the same lines."""
        return _AxisLines(self.motion, self.drive[:0], width) if self.is_broad else self


def _axis_lines(run: Run, axis: str, duration: float) -> _AxisLines:
    motion, drive = run.scales[axis].rate / (2 * np.pi), run.lines[axis]
    width = max(0.06 * motion, 4.0 / duration) if drive.size < MIN_LINES_OF_DENSE_DRIVE else 4.0 / duration
    return _AxisLines(motion * np.arange(1.0, MOTION_HARMONICS + 1), drive, width)


def _near_any(frequency: Array, known: Sequence[_AxisLines]) -> NDArray[np.bool_]:
    """Which frequencies lie near a line of an axis, shape of ``frequency``."""
    return np.any([near_lines(frequency, lines.all, lines.width) for lines in known], axis=0)


def strongest_interfering_line(fit: Fit) -> float | None:
    """Frequency [Hz] of the strongest line of a sense channel that is no harmonic of motion or drive, or None.

    Where the drive has many lines, a tone that coincides with one of them is a candidate too. Mains hum is included;
    the fit decides by its amplitude whether it is noise or interference.
    """
    strongest: tuple[float, float | None] = (LINE_DETECTION_RATIO, None)
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
            residual = output.data - signal
            residual = residual[output.guard[0] : residual.size - output.guard[1]]
            power = periodogram(residual - residual.mean())[: output.bins]
            duration = residual.size * output.step
            frequency = np.arange(power.size) / duration
            known = [_axis_lines(run, axis, duration) for axis in output.axes]
            all_lines, width = np.concatenate([lines.all for lines in known]), max(lines.width for lines in known)
            noise = noise_psd(residual, power.size, output.step, all_lines, width)[0]
            around = percentile_filter(power, 50, 2 * NEIGHBOUR_BINS + 1) / MEDIAN_TO_MEAN_POWER
            ratio = power / np.maximum(noise, around)
            ratio[_near_any(frequency, known) | (frequency < 2.5 / duration)] = 0.0
            strongest = max(strongest, _strongest(ratio, power, duration))
            if any(lines.is_broad for lines in known):
                known = [lines.without_broad_drive(4.0 / duration) for lines in known]
                ratio = power / percentile_filter(power, 90, 2 * NEIGHBOUR_BINS + 1)
                ratio[_near_any(frequency, known) | (frequency < 2.5 / duration)] = 0.0
                strongest = max(strongest, _strongest(ratio, power, duration))
    return strongest[1]


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


def with_interference_line(likelihood: Likelihood, fit: Fit) -> Fit:
    """The same fit, with the strongest interfering line in the natural scales of its runs."""
    line = strongest_interfering_line(fit)
    if line is None:
        return fit
    runs = tuple(
        replace(run, scales={axis: replace(scales, line=line) for axis, scales in run.scales.items()})
        for run in fit.model.runs
    )
    model = Model(runs, fit.model.device, fit.model.candidates, fit.model.mains)
    return replace(fit, model=model)
