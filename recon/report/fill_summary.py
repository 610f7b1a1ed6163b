"""Times after which fractions of the pixels were visited, for summary.json."""

from __future__ import annotations

import numpy as np

from recon.imaging.coverage import fill_against_time
from recon.quality.defects import unrecoverable_intervals
from recon.steps.reconstruction import Reconstruction
from scanner.device import AXES
from scanner.sample_ranges import to_sample_ranges

FILL_FRACTIONS = (0.25, 0.5, 0.75, 0.9, 0.99)
"""Fractions of visited pixels for which the time is stated."""

MAX_FILL_SAMPLES = 1 << 22
"""Samples from the start of the scan in which these times are searched: 0.8 s at 5 MS/s, longer than any frame."""


def seconds_to_fill(result: Reconstruction) -> dict[str, float | None]:
    """Frame time after which each of ``FILL_FRACTIONS`` was reached [s]; None where the scan was too short for it.

    Samples in gaps of the intensity and those at an unknown angle visit no pixel.
    """
    x, y = (result.beam.axes[axis].angle.read(0, MAX_FILL_SAMPLES) for axis in AXES)
    gaps = [
        (defect.start, defect.stop)
        for defect in result.defects
        if defect.channel == result.intensity.name and defect.kind == "gap" and defect.fraction == 1.0
    ]
    unknown = unrecoverable_intervals(result.motion, result.defects)
    for first, stop in to_sample_ranges([*gaps, *unknown], result.intensity):
        x[first:stop] = np.nan
    time, fill = fill_against_time(x, y, result.intensity.sample_rate, result.picture.grid)
    at = np.searchsorted(fill, FILL_FRACTIONS)
    return {
        f"{wanted:g}": float(time[k]) if k < time.size else None for wanted, k in zip(FILL_FRACTIONS, at, strict=True)
    }
