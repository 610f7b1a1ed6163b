"""The figures of a reconstruction for summary.json and the tables of the report."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from estimation.least_squares import between_variance
from recon.evaluation import AxisEvaluation
from recon.imaging import blur
from recon.imaging.picture import fill_factor
from recon.imaging.sample_motion.rigid_motion import SampleMotion
from recon.imaging.scan_phase.phase_error import PhaseError
from recon.imaging.scan_phase.readout_phase import UNDESCRIBED_DELAY_SD_S, common_delay
from recon.report.fill_summary import seconds_to_fill
from recon.report.z_summary import position_summary, stack_summary
from recon.steps.reconstruction import Reconstruction
from recon.steps.z_slices import ZSlices
from scanner.arrays import Array
from scanner.device import AXES
from scanner.errors import BadInput
from scanner.motion import AxisMotion, in_proportion_to_amplitude, rms_phase, typical_amplitude

MIN_SD_RAD = 1e-9
"""Least standard error of a phase: without noise it can be 0."""


MIN_CONTRADICTION_SDS = 3.0
"""Excess of chi-square over its degrees of freedom, in its standard deviations, from which slices contradict each
other."""


def picture_phase_error(errors: list[PhaseError], axis: str) -> dict[str, Any]:
    """Phase error that the picture shows [degrees]: of each time slice, and the mean of the slices that determine one.

    Each has its standard error, which is infinite where the picture determines nothing. ``scatter`` is the standard
    deviation between slices that contradict each other, 0 where they agree. As the mean is that of the scan, its
    standard error contains the scatter of the slices that determine nothing only.
    """
    estimates = [getattr(error, axis) for error in errors]
    slices = [
        {"time": error.time, "value": math.degrees(estimate.value), "sd": math.degrees(estimate.sd)}
        for error, estimate in zip(errors, estimates, strict=True)
    ]
    determined = [estimate for estimate in estimates if np.isfinite(estimate.sd)]
    if not determined:
        return {"value": math.nan, "sd": math.inf, "scatter": 0.0, "slices": slices}
    value, sd = (np.array(column) for column in zip(*determined, strict=True))
    excess = between_variance(value, np.maximum(sd, MIN_SD_RAD), MIN_CONTRADICTION_SDS)
    unknown_share = 1.0 - sd.size / len(errors)
    mean_sd = math.sqrt(float(np.mean(sd**2) + excess * unknown_share) / sd.size)
    return {
        "value": math.degrees(value.mean()),
        "sd": math.degrees(mean_sd),
        "scatter": math.degrees(math.sqrt(excess)),
        "slices": slices,
    }


AXIS_QUANTITIES = (
    "phase_sd_deg", "bound_deg", "within_bound", "sign", "readout_phase_deg", "phase_rmse_deg", "angle_rmse_rad",
)  # fmt: skip
"""Quantities of an axis that the summary also lists by quantity (CONTRACT, summary.json)."""


def readout_phase_summary(result: Reconstruction, axis: str) -> dict[str, Any] | None:
    """Phase error of the readout that was found and removed [degrees]; None where nothing determined it."""
    found = result.readout_phase.get(axis)
    if found is None:
        return None
    return {"value": math.degrees(found.value), "sd": math.degrees(found.sd), "from": "picture"}


def readout_as_stated_summary(result: Reconstruction, axis: str) -> dict[str, float | None] | None:
    """What the phase would be known to without the uncertainty of the readout's phase, which the picture is to measure.

    ``assumed_delay_us`` is the standard deviation of the delay that was assumed; None where the picture measured the
    phase. The result is None where no readout's phase was searched.
    """
    if axis not in result.estimator_phase_sd:
        return None
    known = result.motion.axes[axis].known
    sd, amplitude = result.estimator_phase_sd[axis][known], result.motion.axes[axis].amplitude[known]
    displacing, noise_sd = in_proportion_to_amplitude(sd, amplitude), angle_noise_phase(result, axis)
    return {
        "phase_sd_deg": math.degrees(rms_phase(sd, amplitude)),
        "within_bound": blur.within_bound(result.phase_bound(axis), sd=displacing, noise_sd=noise_sd),
        "assumed_delay_us": None if axis in result.readout_phase else 1e6 * UNDESCRIBED_DELAY_SD_S,
    }


def common_delay_summary(result: Reconstruction) -> dict[str, float] | None:
    """Delay of the signals of both axes that explains their phase errors [µs]; None where none does."""
    delay = common_delay(result.motion, result.readout_phase)
    return None if delay is None else {"value": 1e6 * delay.value, "sd": 1e6 * delay.sd}


def axis_summary(result: Reconstruction, axis: str) -> dict[str, Any]:
    """What the summary says of one axis."""
    own, bound = known_part(result.motion.axes[axis]), result.phase_bound(axis)
    error, scale = result.evaluation.get(axis), result.picture.grid.angle_scale
    metres, noise_sd = result.picture.grid.metres_per_radian, angle_noise_phase(result, axis)
    displacing = displacing_phase(own, error)
    summary: dict[str, Any] = {
        "phase_sd_deg": math.degrees(rms_phase(own.phase_sd, own.amplitude)),
        "bound_deg": float(np.degrees(bound)),
        "within_bound": blur.within_bound(bound, sd=displacing, noise_sd=noise_sd)
        if error is None
        else blur.within_bound(bound, error=displacing, noise_sd=noise_sd),
        "sign": own.sign,
        "amplitude_rad": scale * typical_amplitude(own.amplitude),
        "amplitude_um": None if metres is None else 1e6 * metres * typical_amplitude(own.amplitude),
        **amplitude_uncertainty(result, axis),
        "amplitude_from": amplitude_source(result, axis),
        "frequency_hz": None if own.reference == "blocks" else mean_frequency(own),
        "phase_drift_deg": float(np.degrees(np.ptp(own.phase))),
        "picture_phase_error_deg": picture_phase_error(result.phase_errors, axis),
        "readout_phase_deg": readout_phase_summary(result, axis),
        "readout_as_stated": readout_as_stated_summary(result, axis),
        "blur_px": blur_parts(result, own, axis, error),
    }
    if error is not None:
        summary |= {
            "phase_rmse_deg": float(np.degrees(error.phase_rmse)),
            "phase_bias_deg": float(np.degrees(np.mean(error.phase))),
            "amplitude_rmse": float(np.sqrt(np.mean(error.amplitude**2))),
            "angle_rmse_rad": scale * error.angle_rmse,
            "mirrored": error.mirrored,
        }
    return summary


def displacing_phase(own: AxisMotion, error: AxisEvaluation | None) -> Array:
    """Phase errors in proportion to the amplitude, or their standard deviations where the truth is not known [rad]."""
    if error is None:
        return in_proportion_to_amplitude(own.phase_sd, own.amplitude)
    return in_proportion_to_amplitude(error.phase, error.true_amplitude)


def mean_frequency(own: AxisMotion) -> float:
    """Mean frequency of an axis, weighted with the squared amplitude [Hz]: at rest the mirror has none."""
    weight = in_proportion_to_amplitude(np.ones_like(own.frequency), own.amplitude) ** 2
    return float(np.average(own.frequency, weights=weight))


def known_part(own: AxisMotion) -> AxisMotion:
    """The motion of an axis without the times at which nothing is known of it, as where its sensor was stopped."""
    if own.known.all():
        return own
    of_time = ("time", "phase", "amplitude", "frequency", "phase_sd", "amplitude_sd")
    return replace(own, **{name: each[own.known] for name in of_time if (each := getattr(own, name)) is not None})


def amplitude_uncertainty(result: Reconstruction, axis: str) -> dict[str, float | None]:
    """Standard deviation of the amplitude, by noise and calibration together and by calibration alone [rad].

    None where nothing calibrates the amplitude.
    """
    own, relative = known_part(result.motion.axes[axis]), result.amplitude_calibration[axis]
    if relative is None:
        return {"amplitude_sd_rad": None, "amplitude_sd_calibration_rad": None}
    scale = result.picture.grid.angle_scale
    calibration = scale * relative * typical_amplitude(own.amplitude)
    noise = 0.0 if own.amplitude_sd is None else scale * float(np.sqrt(np.mean(own.amplitude_sd**2)))
    return {"amplitude_sd_rad": math.hypot(noise, calibration), "amplitude_sd_calibration_rad": calibration}


def amplitude_source(result: Reconstruction, axis: str) -> str | None:
    """What the amplitude comes from: "readout", "edges" or "field"; None where nothing calibrates it."""
    calibrated = result.amplitude_calibration[axis] is not None
    if result.motion.estimator == "edges" and f"sync_{axis}" in result.motion.info:
        return "edges" if calibrated else "field"
    return "readout" if calibrated else None


def blur_parts(result: Reconstruction, own: AxisMotion, axis: str, error: AxisEvaluation | None) -> dict[str, float]:
    """Blur of one axis in pixels, by its causes (see ``recon.imaging.blur``)."""
    grid = result.picture.grid
    half = grid.half_angle_x if axis == "x" else grid.half_angle_y
    amplitude = np.zeros(1) if error is None else error.amplitude - np.mean(error.amplitude)
    return blur.blur_by_cause(
        typical_amplitude(own.amplitude),
        half,
        result.pixels(axis),
        displacing_phase(own, error),
        amplitude,
        spot_px(result, axis),
        float(sample_displacement_px(result)[AXES.index(axis)]),
        own.angle_noise_sd / grid.pixel_angle[AXES.index(axis)],
    )


def spot_px(result: Reconstruction, axis: str) -> float:
    """Standard deviation of the spot along an axis, as given or that of the simulation [px]; 0 where unknown.

    A simulation states the spot as a fraction of the field's width. The spot is as high as it is wide.
    """
    if result.spot is not None or result.truth is None:
        return result.spot or 0.0
    grid = result.picture.grid
    return result.truth.spot_sd * 2.0 * grid.half_angle_x / grid.pixel_angle[AXES.index(axis)]


def angle_noise_phase(result: Reconstruction, axis: str) -> float:
    """The phase error [rad] that displaces no sample by more than the noise in single samples of the angle does."""
    half = dict(zip(AXES, (result.picture.grid.half_angle_x, result.picture.grid.half_angle_y), strict=True))
    return result.motion.axes[axis].angle_noise_sd / half[axis]


def sample_displacement_sd(motion: SampleMotion) -> Array:
    """Standard deviation of the sample's position in x and y at each knot, shape (knots, 2) [px].

    A sample in which no motion was found is displaced by what was not followed alone: the standard deviation of its
    position is then that of a single block, of which the picture is the mean over many.
    """
    return motion.sd if motion.moving else np.tile(motion.left, (len(motion.sd), 1))


def sample_displacement_px(result: Reconstruction) -> Array:
    """Standard deviation of the sample's position in x and y, rms over the scan, shape (2,) [px].

    It is 0 where no motion was estimated.
    """
    if result.sample_motion is None:
        return np.zeros(len(AXES))
    return np.asarray(np.sqrt(np.mean(sample_displacement_sd(result.sample_motion) ** 2, axis=0)))


def intensity_drift_summary(result: Reconstruction) -> list[dict[str, Any] | None] | None:
    """Drift that was removed, by detector; None where no removal was asked for."""
    if not result.intensity_drift:
        return None
    return [
        None if drift is None else {"kind": drift.kind, "rms": float(np.std(drift.values)), "sd": drift.sd}
        for drift in result.intensity_drift
    ]


def sample_motion_summary(result: Reconstruction) -> dict[str, Any] | None:
    """Motion of the sample; None where it was not asked for or not determined."""
    motion = result.sample_motion
    if motion is None:
        return None
    return {
        "moving": motion.moving,
        "peak_to_peak_px": dict(zip(AXES, np.ptp(motion.shift, axis=0).tolist(), strict=True)),
        "sd_px": dict(zip(AXES, np.sqrt(np.mean(motion.sd**2, axis=0)).tolist(), strict=True)),
        "log_likelihood_gain": motion.gain,
        "bandwidth_hz": 0.5 * result.intensity.sample_rate / motion.length,
        "vibrations": [
            {
                "frequency_hz": each.frequency * result.intensity.sample_rate,
                "peak_to_peak_px": dict(zip(AXES, (2.0 * each.peak).tolist(), strict=True)),
            }
            for each in motion.vibrations
        ],
        "left_px": dict(zip(AXES, motion.left.tolist(), strict=True)),
        "displaced_px": dict(zip(AXES, sample_displacement_px(result).tolist(), strict=True)),
        "within_tolerance": {
            axis: blur.within_bound(result.p, sd=sd)
            for axis, sd in zip(AXES, sample_displacement_sd(motion).T, strict=True)
        },
    }


def summarise(result: Reconstruction, slices: ZSlices | None = None) -> dict[str, Any]:
    """The summary: quantities by axis, and the same grouped by quantity as CONTRACT names them.

    Args:
        result: of the reconstruction.
        slices: of the stack that was written.
    """
    axes = {axis: axis_summary(result, axis) for axis in AXES}
    grouped = {
        key: {axis: axes[axis][key] for axis in AXES}
        for key in AXIS_QUANTITIES
        if all(key in own for own in axes.values())
    }
    return {
        "estimator": result.motion.estimator,
        "name": result.name,
        "axes": list(AXES),
        "angle": result.picture.grid.angle,
        **grouped,
        **axes,
        "readout_delay_us": common_delay_summary(result),
        "tolerance_px": result.p,
        "detectors": list(result.picture.detectors),
        "intensity_unit": result.intensity.unit,
        "clock_doubted": result.clock_doubted,
        "fill": fill_factor(result.picture.coverage),
        "resolution_px": result.resolution_px,
        "seconds_to_fill": seconds_to_fill(result),
        "samples": int(result.picture.coverage.sum()),
        "outside": result.picture.outside,
        "dropped": result.unlocated_samples,
        "intensity_drift": intensity_drift_summary(result),
        "sample_motion": sample_motion_summary(result),
        "stack": stack_summary(slices),
        "grid": asdict(result.picture.grid),
        "position_z": position_summary(result),
        "trouble": [asdict(each) for each in result.defects],
        "affected": float(np.mean(result.affected)),
        "seconds": result.seconds,
        "recorded_seconds": result.duration,
        "picture": _picture_score(result),
        "limits": result.limits,
        "notes": result.notes,
        "info": dict(result.motion.info),
    }


def _picture_score(result: Reconstruction) -> dict[str, Any] | None:
    """Rms error of the picture against the noiseless scene of a simulation, and its magnification.

    None without a scene, and where it cannot be compared: scene or picture have one value only.
    """
    if result.truth is None or result.truth.scene is None:
        return None
    try:
        return asdict(blur.compare_with_scene(result.picture, result.truth.scene, *is_mirrored(result)))
    except BadInput:
        return None


def is_mirrored(result: Reconstruction) -> tuple[bool, bool]:
    """Whether the picture shows the scene mirrored in x, in y; False for an axis without a known truth."""
    x, y = (axis in result.evaluation and result.evaluation[axis].mirrored for axis in AXES)
    return x, y
