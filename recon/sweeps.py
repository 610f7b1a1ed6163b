"""A stretch of the scan, small enough for a page: what the report's phase sliders map again in the browser.

The mapping itself is templates/sweeps.js. Here its data are packed: intensities as bytes, and each axis's slow phase
and amplitude, from which the angles are made anew with whatever phase a slider adds.
"""

from __future__ import annotations

import base64
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon import views
from recon.pipeline import AXES, REGISTERED, Reconstruction
from recon.trouble import samples, unknown
from scanner.demodulate import block_length, block_phasors
from scanner.motion import AxisMotion

Array = NDArray[np.float64]

SHOWN = 300_000  # samples that a page holds
RUN = 32  # samples in succession: a run of them is kept and a stretch left out, where there are more
READ = 1 << 22  # samples of the stretch, at the most
KNOTS = 2000  # of slow phase and amplitude
CYCLES = 4.0  # of the motion in a knot, as in the estimators
SIDE = 256  # pixels of the longer side
NONE = 0  # code of an intensity that is not there; the others are 1 to 255


def sweeps(result: Reconstruction) -> dict[str, Any] | None:
    """What templates/sweeps.js takes, JSON-serialisable; None for a scan too short for a slow phase.

    The stretch is the scan's middle, as long as is registered of a scan at the most: sweeps that are further apart in
    time would show a drift of the device as a fault of the phase.
    """
    intensity = result.intensity
    first, count = _stretch(result)
    own = {axis: _slow(result.motion.axes[axis], first, count) for axis in AXES}
    if any(knots["amplitude"].size < 2 for knots in own.values()):
        return None
    stride = max(RUN, math.ceil(RUN * count / SHOWN))
    kept = (np.arange(0, count - RUN + 1, stride)[:, None] + np.arange(RUN)).ravel()
    seen = intensity.read(first, first + count).astype(np.float64)
    for low, high in samples(unknown(result.motion, result.trouble), intensity):  # no place on the picture
        seen[max(low - first, 0) : max(high - first, 0)] = np.nan
    codes, limits = _codes(seen[kept], views.contrast(result.picture.image))
    grid = result.picture.grid
    scale = min(1.0, SIDE / max(grid.width, grid.height))
    half = {"x": grid.half_angle_x, "y": grid.half_angle_y}
    return {
        "width": max(1, round(scale * grid.width)),
        "height": max(1, round(scale * grid.height)),
        "rate": intensity.sample_rate,
        "run": RUN,
        "stride": stride,
        "limits": limits,
        "intensity": _packed(codes),
        "seconds": [first / intensity.sample_rate, (first + count) / intensity.sample_rate],
        "axes": [
            {
                "name": axis,
                "pixels": result.pixels(axis),
                "frequency": knots["frequency"],
                "start": knots["start"],
                "step": knots["step"],
                "amplitude": _packed((knots["amplitude"] / half[axis]).astype("<f4")),
                "phase": _packed(knots["phase"].astype("<f4")),
            }
            for axis, knots in own.items()
        ],
    }


def _stretch(result: Reconstruction) -> tuple[int, int]:
    """First sample and number of samples."""
    slowest = min(float(np.median(axis.frequency)) for axis in result.motion.axes.values())
    intensity = result.intensity
    count = min(intensity.size, READ, round(REGISTERED * intensity.sample_rate / slowest))
    return (intensity.size - count) // 2, count


def _slow(axis: AxisMotion, first: int, count: int) -> dict[str, Any]:
    """Amplitude [rad] and phase [rad] against a carrier of ``frequency`` [Hz], times [s] from sample ``first`` on."""
    track = axis.angle
    frequency = float(np.median(axis.frequency))
    block = max(block_length(frequency, track.sample_rate, CYCLES), math.ceil(count / KNOTS))
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


def _codes(seen: Array, contrast: tuple[float, float]) -> tuple[NDArray[np.uint8], tuple[float, float]]:
    """Intensities, shape (n,) or (n, detectors), as bytes, and the picture's black and white in the same measure."""
    values = seen if seen.ndim == 1 else seen.mean(-1)
    present = np.isfinite(values)
    low, high = np.percentile(values[present], [0.05, 99.95]) if present.any() else (0.0, 1.0)
    gain = 254.0 / max(float(high - low), 1e-300)
    codes = np.full(values.shape, NONE, np.uint8)
    codes[present] = 1 + np.clip(np.rint(gain * (values[present] - low)), 0, 254).astype(np.uint8)
    black, white = (float(1.0 + gain * (limit - low)) for limit in contrast)
    return codes, (black, white)


def _packed(values: NDArray[Any]) -> str:
    return base64.b64encode(values.tobytes()).decode()
