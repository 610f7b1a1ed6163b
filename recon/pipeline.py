"""From a recording to a sharp picture: estimate, map, register, score, report."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from estimation.estimate import default_estimator, estimate
from estimation.signals import device_of
from recon import blur
from recon.coverage import fill_against_time
from recon.mapping import Grid, Picture, fill_factor, fill_holes, map_samples
from recon.output import finite, replacing_folder, write_json, write_motion, write_tiff
from recon.registration import PhaseError, phase_error
from recon.score import AxisError, Truth, axis_error, truth_of
from scanner.channel import check_signal
from scanner.device import Device
from scanner.errors import DeviceInvalid
from scanner.motion import AxisMotion, Motion
from scanner.recording import Recording

Array = NDArray[np.float64]

AXES = ("x", "y")
SLICE = 0.01  # seconds of scan in which forward and backward sweeps are registered
MOST_SLICES = 24
FILLS = (0.25, 0.5, 0.75, 0.9, 0.99)


@dataclass(frozen=True)
class Options:
    """What a user may ask of a reconstruction.

    Attributes:
        device: TOML file in place of the recording's own device.
        estimator: by name; by what was recorded where None.
        pixels: width, height. p: pixels of shift that are tolerated.
        flips: axes whose sign is turned.
        fill_radius: holes up to this many pixels are filled, and marked as fill; 0 fills none.
        spot: standard deviation of the beam's spot [px], for the blur's account; the recording does not tell it.
    """

    device: Path | None = None
    estimator: str | None = None
    pixels: tuple[int, int] = (400, 400)
    p: float = 1.0
    flips: Mapping[str, bool] = field(default_factory=dict)
    fill_radius: int = 0
    spot: float | None = None


@dataclass(frozen=True)
class Reconstruction:
    """One recording's picture and all that was found on the way.

    Attributes:
        motion, picture: the result.
        p: pixels tolerated. spot: as in ``Options``.
        seen: phase error of each time slice as forward and backward sweeps show it.
        errors: estimate against truth by axis; empty without a truth.
        truth: None without one.
        notes: what a reader has to know, a line each.
        seconds: taken, without writing.
        recorded: length of the intensity [s].
        name: of the recording.
    """

    motion: Motion
    picture: Picture
    p: float
    spot: float | None
    seen: list[PhaseError]
    errors: Mapping[str, AxisError]
    truth: Truth | None
    notes: list[str]
    seconds: float
    recorded: float
    name: str

    def pixels(self, axis: str) -> int:
        """Pixels of the picture along an axis."""
        return self.picture.grid.width if axis == "x" else self.picture.grid.height

    def bound(self, axis: str) -> float:
        """p/m of an axis [rad] (chen2020 eq 7)."""
        return blur.bound(self.p, self.pixels(axis) / 2)


def reconstruct(recording: Recording, options: Options, truth: Truth | None = None) -> Reconstruction:
    """Track the motion, map the intensity, register forward against backward, compare with the truth if there is one.

    Raises:
        BadInput: the recording or the device does not serve.
    """
    began = time.perf_counter()
    with tqdm(total=4, desc="reconstruct", file=sys.stderr, leave=False, disable=None) as progress:
        intensity = recording.require("intensity", "a picture needs it")
        check_signal(intensity)
        device = device_of(recording, Device.load(options.device) if options.device else None)
        for axis in AXES:
            device.axis(axis)
        method = options.estimator or default_estimator(recording, device)
        progress.set_postfix_str(f"{method} (compiled once, at the first run)")
        motion = estimate(recording, device, method, options.flips)
        progress.update()
        progress.set_postfix_str("mapping")
        grid, notes = _grid(device, motion, options)
        values = intensity.read()
        x, y = (motion.axes[axis].angle.values for axis in AXES)
        picture = map_samples(x, y, values, grid)
        if not picture.coverage.any():
            raise DeviceInvalid(
                "no sample lies in the field of view", channel="scan", hint="check half_angle_x and half_angle_y"
            )
        progress.update()
        progress.set_postfix_str("registration")
        seen = _register(motion, values, grid)
        progress.update()
        errors = {axis: axis_error(motion.axes[axis], *truth.angles[axis]) for axis in truth.angles} if truth else {}
        progress.update()
    for axis in AXES:
        if motion.axes[axis].sign == "ambiguous":
            notes.append(f"the sign of {axis} is ambiguous: the picture may be mirrored; --flip-{axis} turns it")
    return Reconstruction(
        motion=motion,
        picture=picture,
        p=options.p,
        spot=options.spot,
        seen=seen,
        errors=errors,
        truth=truth,
        notes=notes,
        seconds=time.perf_counter() - began,
        recorded=intensity.size / intensity.sample_rate,
        name=recording.name,
    )


def reconstruct_file(path: Path, output: Path, options: Options) -> dict[str, Any]:
    """``reconstruct`` a recording's file and write everything into the folder ``output``; returns the summary."""
    from recon.report import reconstruction_report
    from recon.views import save_picture

    with Recording.open(path) as recording, replacing_folder(output) as folder:
        result = reconstruct(recording, options, truth_of(path))
        summary = finite(summarise(result) | {"output": str(output), "recording": str(path)})
        write_tiff(folder / "image.tif", result.picture.image)
        write_tiff(folder / "coverage.tif", result.picture.coverage)
        if options.fill_radius:
            image, mask = fill_holes(result.picture, options.fill_radius)
            write_tiff(folder / "filled.tif", image)
            write_tiff(folder / "fill.tif", mask.astype(np.uint8))
        write_motion(folder / "motion.h5", result.motion)
        write_json(folder / "summary.json", summary)
        save_picture(folder / "image.png", result.picture)
        (folder / "report.html").write_text(reconstruction_report(result, summary), encoding="utf-8")
    return summary


def _grid(device: Device, motion: Motion, options: Options) -> tuple[Grid, list[str]]:
    if device.scan is not None:
        return Grid(*options.pixels, device.scan.half_angle_x, device.scan.half_angle_y), []
    half = {axis: float(np.max(motion.axes[axis].amplitude)) for axis in AXES}
    note = (
        f"the device states no [scan]: the field is the motion's own, {half['x']:.4g} x {half['y']:.4g} rad half angles"
    )
    return Grid(*options.pixels, half["x"], half["y"]), [note]


def _register(motion: Motion, intensity: Array, grid: Grid) -> list[PhaseError]:
    x, y = (motion.axes[axis].angle for axis in AXES)
    amplitudes = []
    for axis in AXES:
        track, own = motion.axes[axis].angle, motion.axes[axis]
        sampled = track.start + np.arange(track.values.size) / track.sample_rate
        amplitudes.append(np.interp(sampled, own.time, own.amplitude))
    slices = int(np.clip(round(intensity.shape[0] / x.sample_rate / SLICE), 1, MOST_SLICES))
    return phase_error(x.values, y.values, intensity, x.sample_rate, grid, amplitudes[0], amplitudes[1], slices)


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
        "seconds": result.seconds,
        "recorded_seconds": result.recorded,
        "picture": _picture_score(result),
        "notes": result.notes,
        "info": dict(result.motion.info),
    }


def seconds_to_fill(result: Reconstruction) -> dict[str, float | None]:
    """Frame time after which each of ``FILLS`` was reached [s]; None where the scan was too short for it."""
    x, y = (result.motion.axes[axis].angle for axis in AXES)
    time, fill = fill_against_time(x.values, y.values, x.sample_rate, result.picture.grid)
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
