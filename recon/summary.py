"""What a reconstruction says of itself in figures: summary.json and the report's tables."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

import numpy as np

from recon import blur
from recon.coverage import fill_against_time
from recon.mapping import fill_factor
from recon.pipeline import AXES, Reconstruction
from recon.registration import PhaseError
from recon.score import AxisError
from scanner.motion import AxisMotion

FILLS = (0.25, 0.5, 0.75, 0.9, 0.99)
FILL_SAMPLES = 1 << 22  # of the scan's beginning, in which the times to fill are looked for


def seen_by_picture(seen: list[PhaseError], axis: str) -> dict[str, Any]:
    """Phase error that the picture shows [degrees]: of each time slice, and the mean of those that tell one; else nan.

    Each has its standard error, infinite where the picture tells nothing.
    """
    slices = [
        {"time": each.time, "value": math.degrees(own.value), "sd": math.degrees(own.sd)}
        for each in seen
        for own in (getattr(each, axis),)
    ]
    told = [estimate for each in seen if np.isfinite((estimate := getattr(each, axis)).sd)]
    if not told:
        return {"value": math.nan, "sd": math.inf, "slices": slices}
    value, sd = (np.array(column) for column in zip(*told, strict=True))
    mean_sd = math.sqrt(float(np.sum(sd**2))) / sd.size
    return {"value": math.degrees(value.mean()), "sd": math.degrees(mean_sd), "slices": slices}


def axis_summary(result: Reconstruction, axis: str) -> dict[str, Any]:
    """What the summary says of one axis."""
    own, bound = result.motion.axes[axis], result.bound(axis)
    error = result.errors.get(axis)
    summary: dict[str, Any] = {
        "phase_sd_deg": float(np.degrees(np.sqrt(np.mean(own.phase_sd**2)))),
        "bound_deg": float(np.degrees(bound)),
        "within_bound": blur.within_bound(bound, sd=own.phase_sd)
        if error is None
        else blur.within_bound(bound, error=error.phase),
        "sign": own.sign,
        "amplitude_rad": float(np.mean(own.amplitude)),
        "frequency_hz": float(np.mean(own.frequency)),
        "phase_drift_deg": float(np.degrees(np.ptp(own.phase))),
        "picture_phase_error_deg": seen_by_picture(result.seen, axis),
        "blur_px": blur_parts(result, own, axis, error),
    }
    if error is not None:
        summary |= {
            "phase_rmse_deg": float(np.degrees(error.phase_rmse)),
            "phase_bias_deg": float(np.degrees(np.mean(error.phase))),
            "amplitude_rmse": float(np.sqrt(np.mean(error.amplitude**2))),
            "angle_rmse_rad": error.angle_rmse,
            "mirrored": error.mirrored,
        }
    return summary


def blur_parts(result: Reconstruction, own: AxisMotion, axis: str, error: AxisError | None) -> dict[str, float]:
    """Blur of one axis in pixels, by its causes (see ``recon.blur``)."""
    grid = result.picture.grid
    half = grid.half_angle_x if axis == "x" else grid.half_angle_y
    phase = own.phase_sd if error is None else error.phase
    amplitude = np.zeros(1) if error is None else error.amplitude - np.mean(error.amplitude)
    spot = result.truth.spot_sd * result.pixels("x") if result.spot is None and result.truth else result.spot or 0.0
    return blur.parts(float(np.mean(own.amplitude)), half, result.pixels(axis), phase, amplitude, spot)


def summarise(result: Reconstruction) -> dict[str, Any]:
    """The summary: quantities by axis, and the same grouped by quantity as CONTRACT names them."""
    axes = {axis: axis_summary(result, axis) for axis in AXES}
    grouped = {
        key: {axis: axes[axis][key] for axis in AXES}
        for key in ("phase_sd_deg", "bound_deg", "within_bound", "sign", "phase_rmse_deg", "angle_rmse_rad")
        if all(key in own for own in axes.values())
    }
    return {
        "estimator": result.motion.estimator,
        "name": result.name,
        "axes": list(AXES),
        **grouped,
        **axes,
        "fill": fill_factor(result.picture.coverage),
        "seconds_to_fill": seconds_to_fill(result),
        "samples": int(result.picture.coverage.sum()),
        "dropped": result.dropped,
        "trouble": [asdict(each) for each in result.trouble],
        "affected": float(np.mean(result.affected)),
        "seconds": result.seconds,
        "recorded_seconds": result.recorded,
        "picture": _picture_score(result),
        "notes": result.notes,
        "info": dict(result.motion.info),
    }


def seconds_to_fill(result: Reconstruction) -> dict[str, float | None]:
    """Frame time after which each of ``FILLS`` was reached [s]; None where the scan was too short for it."""
    x, y = (result.motion.axes[axis].angle for axis in AXES)
    time, fill = fill_against_time(x.read(0, FILL_SAMPLES), y.read(0, FILL_SAMPLES), x.sample_rate, result.picture.grid)
    at = np.searchsorted(fill, FILLS)
    return {f"{wanted:g}": float(time[k]) if k < time.size else None for wanted, k in zip(FILLS, at, strict=True)}


def _picture_score(result: Reconstruction) -> dict[str, Any] | None:
    """Picture against the noiseless scene where a simulation told it: rms, magnification taken out apart."""
    if result.truth is None or result.truth.scene is None:
        return None
    return asdict(blur.picture_error(result.picture, result.truth.scene, *mirrored(result)))


def mirrored(result: Reconstruction) -> tuple[bool, bool]:
    """Whether the picture shows the scene mirrored in x, in y, as far as a truth tells."""
    x, y = (axis in result.errors and result.errors[axis].mirrored for axis in AXES)
    return x, y
