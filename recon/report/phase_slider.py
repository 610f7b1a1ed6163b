"""Data of the report's phase sliders: a segment of the scan that is small enough for a page.

The browser maps the segment (templates/sweeps.js). The data are the intensities as bytes, and the slow phase and
amplitude of each axis, from which the script computes the angles with the phase that a slider adds.
"""

from __future__ import annotations

import base64
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.quality.defects import unrecoverable_intervals
from recon.report.figures import contrast_limits
from recon.steps.reconstruction import Reconstruction
from recon.steps.registration_segments import MAX_REGISTERED_PERIODS
from scanner.arrays import Array
from scanner.device import AXES
from scanner.lock_in import block_length, block_phasors
from scanner.motion import AxisMotion
from scanner.sample_ranges import to_sample_ranges

MAX_SAMPLES = 300_000
"""Samples in a page: as base64 they take 0.4 MB."""

RUN_SAMPLES = 32
"""Successive samples of a run. If the segment has more than ``MAX_SAMPLES``, equally spaced runs of it are used."""

MAX_SEGMENT_SAMPLES = 1 << 22
"""Samples of the segment, which bounds the memory."""

MAX_KNOTS = 2000
"""Knots of slow phase and amplitude: more than the eye can use, and 16 kB an axis."""

CYCLES_PER_KNOT = 4.0
"""Cycles of the motion in a knot, as in the estimators' slow clock."""

MAX_SIDE_PX = 256
"""Pixels of the longer side: a slider then maps the segment again without delay."""

MISSING_CODE = 0
"""Code of a missing intensity; the others are 1 to 255."""


def phase_slider_data(result: Reconstruction) -> dict[str, Any] | None:
    """Input of templates/sweeps.js, JSON-serialisable; None if the scan is too short for a slow phase.

    The segment lies in the middle of the scan and is no longer than what the registration uses of a scan: half-periods
    that are further apart in time would show a drift of the device as a phase error.
    """
    intensity = result.intensity
    first, count = _segment(result)
    knots_of = {axis: _slow_motion(result.beam.axes[axis], first, count) for axis in AXES}
    if any(knots["amplitude"].size < 2 for knots in knots_of.values()):
        return None
    stride = max(RUN_SAMPLES, math.ceil(RUN_SAMPLES * count / MAX_SAMPLES))
    selected = (np.arange(0, count - RUN_SAMPLES + 1, stride)[:, None] + np.arange(RUN_SAMPLES)).ravel()
    values = intensity.read(first, first + count).astype(np.float64)
    unlocated = unrecoverable_intervals(result.motion, result.defects)
    for low, high in to_sample_ranges(unlocated, intensity):
        values[max(low - first, 0) : max(high - first, 0)] = np.nan
    codes, limits = _codes(values[selected], contrast_limits(result.picture.image))
    grid = result.picture.grid
    scale = min(1.0, MAX_SIDE_PX / max(grid.width, grid.height))
    half = {"x": grid.half_angle_x, "y": grid.half_angle_y}
    return {
        "width": max(1, round(scale * grid.width)),
        "height": max(1, round(scale * grid.height)),
        "rate": intensity.sample_rate,
        "run": RUN_SAMPLES,
        "stride": stride,
        "limits": limits,
        "intensity": _encode(codes),
        "seconds": [first / intensity.sample_rate, (first + count) / intensity.sample_rate],
        "axes": [
            {
                "name": axis,
                "pixels": result.pixels(axis),
                "frequency": knots["frequency"],
                "start": knots["start"],
                "step": knots["step"],
                "amplitude": _encode((knots["amplitude"] / half[axis]).astype("<f4")),
                "phase": _encode(knots["phase"].astype("<f4")),
            }
            for axis, knots in knots_of.items()
        ],
    }


def _segment(result: Reconstruction) -> tuple[int, int]:
    """First sample and number of samples."""
    slowest = min(float(np.median(axis.frequency)) for axis in result.motion.axes.values())
    intensity = result.intensity
    count = min(intensity.size, MAX_SEGMENT_SAMPLES, round(MAX_REGISTERED_PERIODS * intensity.sample_rate / slowest))
    return (intensity.size - count) // 2, count


def _slow_motion(axis: AxisMotion, first: int, count: int) -> dict[str, Any]:
    """Amplitude [rad] and phase [rad] against a carrier of ``frequency`` [Hz], times [s] from sample ``first`` on."""
    track = axis.angle
    frequency = float(np.median(axis.frequency))
    block = max(block_length(frequency, track.sample_rate, CYCLES_PER_KNOT), math.ceil(count / MAX_KNOTS))
    angle = np.asarray(track.read(first, first + count), np.float64)
    time, phasors = block_phasors(angle, track.sample_rate, 0.0, frequency, block)
    phase = np.angle(phasors * np.exp(-2j * np.pi * frequency * time))
    known = np.isfinite(phase)
    phase[known] = np.unwrap(phase[known])
    return {
        "frequency": frequency,
        "start": 0.5 * (block - 1) / track.sample_rate,
        "step": block / track.sample_rate,
        "amplitude": np.abs(phasors),
        "phase": phase,
    }


def _codes(intensity: Array, contrast: tuple[float, float]) -> tuple[NDArray[np.uint8], tuple[float, float]]:
    """Intensities, shape (n,) or (n, detectors), as bytes, and black and white of the picture on the same scale."""
    values = intensity if intensity.ndim == 1 else intensity.mean(-1)
    present = np.isfinite(values)
    low, high = np.percentile(values[present], [0.05, 99.95]) if present.any() else (0.0, 1.0)
    gain = 254.0 / max(float(high - low), 1e-300)
    codes = np.full(values.shape, MISSING_CODE, np.uint8)
    codes[present] = 1 + np.clip(np.rint(gain * (values[present] - low)), 0, 254).astype(np.uint8)
    black, white = (float(1.0 + gain * (limit - low)) for limit in contrast)
    return codes, (black, white)


def _encode(values: NDArray[Any]) -> str:
    return base64.b64encode(values.tobytes()).decode()
