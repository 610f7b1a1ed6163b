"""Correction of an intensity channel for the drift of its detectors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import prod

import numpy as np
from numpy.typing import NDArray

from estimation.sensor_hum import LineBlock
from recon.imaging.gridding import find_sample_pixels
from recon.imaging.intensity_drift import IntensityDrift, SampleReader, estimate_intensity_drift
from recon.imaging.intensity_drift_equations import DriftKind
from recon.imaging.picture import Grid, detector_names
from recon.imaging.pixel_noise import SampleNoise
from scanner.arrays import Array
from scanner.channel import Channel, LazySamples
from scanner.device import AXES
from scanner.motion import Motion
from scanner.wording import quantity

UNDETERMINED = (
    "no drift was removed, because the samples do not determine one; that needs samples with noise in pixels that were "
    "visited at times far apart and are not dark"
)
"""Note where :func:`measure_intensity_drift` returns None."""

MIN_DRIFT_SDS = 3.0
"""Root mean square of a drift, in standard deviations of its value at a moment, from which the phase is measured again
without it. It was at most 1.2 in 15 scans with a steady detector, 5.3 and 6.3 in two whose gain falls by 3 %. In four
kinds of smaller drift, two scans each, the phase changed by at most 0.3 of its standard deviation."""


def measure_intensity_drift(
    beam: Motion, intensity: Channel, grid: Grid, kind: DriftKind, flicker: Sequence[LineBlock] = ()
) -> tuple[IntensityDrift | None, ...]:
    """Drift of each detector; None where the samples do not determine one.

    Args:
        beam: motion whose angles are on the intensity's clock.
        intensity: shape (n,) or (n, detectors).
        grid: the pixels.
        kind: what drifts.
        flicker: lines that the drift contains.
    """
    lines = sorted({line.frequency for part in flicker for line in part.lines})
    x, y = (beam.axes[axis].angle for axis in AXES)

    def reader(detector: int) -> SampleReader:
        def read(first: int, stop: int) -> tuple[NDArray[np.int32], Array]:
            values = intensity.read(first, stop).reshape(stop - first, -1)
            pixel = find_sample_pixels(x.read(first, stop), y.read(first, stop), grid)
            return pixel, np.ascontiguousarray(values[:, detector])

        return read

    detectors, pixels = prod(intensity.shape[1:]), grid.width * grid.height
    return tuple(
        estimate_intensity_drift(reader(detector), intensity.size, pixels, intensity.sample_rate, kind, lines)
        for detector in range(detectors)
    )


def exceeds_uncertainty(drifts: Sequence[IntensityDrift | None]) -> bool:
    """Return whether a detector's drift is larger than its uncertainty, ``MIN_DRIFT_SDS``.

    Args:
        drifts: by detector; None where none was determined.
    """
    return any(drift is not None and float(np.std(drift.values)) > MIN_DRIFT_SDS * drift.sd for drift in drifts)


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


def add_drift_errors(
    noise: Sequence[SampleNoise | None], drifts: Sequence[IntensityDrift | None]
) -> tuple[SampleNoise | None, ...]:
    """The noise of a sample of each detector, measured without the drift, with the errors of the drift.

    Args:
        noise: by detector; None where none was measured.
        drifts: by detector; None where none was removed, and empty if none was to be removed.
    """
    factors = [1.0 if drift is None else drift.noise_factor for drift in drifts] or [1.0] * len(noise)
    return tuple(None if each is None else each.scaled(k) for each, k in zip(noise, factors, strict=True))


def describe_drift(drifts: Sequence[IntensityDrift | None], intensity: Channel) -> list[str]:
    """What a reader has to know of the drifts that were removed, a line for each detector.

    Args:
        drifts: by detector.
        intensity: whose unit and names of detectors are stated.
    """
    lines = []
    for detector, drift in zip(detector_names(intensity.detectors, len(drifts)), drifts, strict=True):
        if drift is None:
            lines.append(f"{detector}: {UNDETERMINED}")
            continue
        change, sd = float(np.std(drift.values)), drift.sd
        if change == 0.0:
            lines.append(f"{detector}: no {drift.kind} drift was found")
            continue
        size = f"{quantity(change, intensity.unit, 3)} rms" if drift.kind == "offset" else f"{100 * change:.3g} % rms"
        error = quantity(sd, intensity.unit, 2) if drift.kind == "offset" else f"{100 * sd:.2g} %"
        lines.append(f"{detector}: {drift.kind} drift of {size}, known to {error} at each moment, was removed")
    return lines
