"""Correction of an intensity channel for the drift of its detectors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from recon.imaging.gridding import find_sample_pixels
from recon.imaging.intensity_drift import DriftKind, IntensityDrift, estimate_intensity_drift
from recon.imaging.picture import Grid
from scanner.arrays import Array
from scanner.channel import READ_CHUNK_SAMPLES, Channel, LazySamples
from scanner.device import AXES
from scanner.motion import Motion


def measure_intensity_drift(
    beam: Motion, intensity: Channel, grid: Grid, kind: DriftKind
) -> tuple[IntensityDrift | None, ...]:
    """Drift of each detector; None where too few pixels were visited twice.

    Args:
        beam: motion whose angles are on the intensity's clock.
        intensity: shape (n,) or (n, detectors).
        grid: the pixels.
        kind: what drifts.
    """
    x, y = (beam.axes[axis].angle for axis in AXES)
    pixel = np.empty(intensity.size, np.int32)
    for first in range(0, intensity.size, READ_CHUNK_SAMPLES):
        stop = min(first + READ_CHUNK_SAMPLES, intensity.size)
        pixel[first:stop] = find_sample_pixels(x.read(first, stop), y.read(first, stop), grid)
    values = intensity.read().reshape(intensity.size, -1)
    pixels = grid.width * grid.height
    return tuple(
        estimate_intensity_drift(pixel, np.ascontiguousarray(detector), pixels, intensity.sample_rate, kind)
        for detector in values.T
    )


def correct_drift(intensity: Channel, drifts: Sequence[IntensityDrift | None]) -> Channel:
    """The channel without the drifts of its detectors, corrected as it is read.

    Args:
        intensity: shape (n,) or (n, detectors).
        drifts: by detector; None leaves a detector as it is.
    """

    def corrected(first: int, stop: int) -> Array:
        values = intensity.read(first, stop)
        detectors = values.reshape(len(values), -1)
        for column, drift in enumerate(drifts):
            if drift is not None:
                detectors[:, column] = drift.correct(detectors[:, column], first)
        return values

    samples = LazySamples(intensity.shape, np.dtype(np.float64), corrected)
    return replace(intensity, raw=samples, first=0, stop=intensity.size, gain=1.0, offset=0.0)


def describe_drift(drifts: Sequence[IntensityDrift | None], unit: str) -> list[str]:
    """What a reader has to know of the drifts that were removed, a line for each detector.

    Args:
        drifts: by detector.
        unit: of the intensity.
    """
    lines = []
    for number, drift in enumerate(drifts):
        detector = f"detector {number}" if len(drifts) > 1 else "the detector"
        if drift is None:
            lines.append(f"{detector}: too few pixels were visited twice to determine a drift; nothing was removed")
            continue
        change, sd = float(np.std(drift.values)), drift.sd
        size = f"{change:.3g} {unit} rms" if drift.kind == "offset" else f"{100 * change:.3g} % rms"
        error = f"{sd:.1g} {unit}" if drift.kind == "offset" else f"{100 * sd:.1g} %"
        lines.append(f"{detector}: {drift.kind} drift of {size}, known to {error} at each moment, was removed")
    return lines
