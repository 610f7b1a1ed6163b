"""Points in space from a recording of angles and ranges."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimation.rail import upper_rail
from recon.pipeline import estimate_motion
from recon.quality.defects import unlocated_samples
from recon.quality.range_timing import describe_range_timing
from recon.quality.sensor_noise import check_sensor_noise
from recon.steps.estimated_motion import EstimatedMotion
from recon.steps.phase_and_drift import correct_readout_phase
from recon.steps.preparation import prepare
from recon.steps.reconstruction import Options
from scanner.arrays import Array
from scanner.channel import Channel
from scanner.device import AXES
from scanner.errors import BadInput
from scanner.geometry import Geometry, locate_points, trace_rays
from scanner.motion import AxisMotion
from scanner.recording import Recording
from scanner.signal_check import check_signal
from scanner.wording import counted

ANGLE_STEP_RAD = 1e-5
"""Step of the central difference of a point by an angle: its square is far below the step, and rounding below 1e-11."""


MAX_RANGE_M = 2000.0
"""Range above which a note asks for the unit: small mirrors collect too little light from further away [m]."""


MIN_RANGE_M = 1e-3
"""Largest range below which a note asks for the unit: no range finder measures so near [m]."""


@dataclass(frozen=True)
class PointCloud:
    """Points with time, intensity and covariance.

    Attributes:
        time: on the recording's clock, shape (n,) [s].
        position: x, y, z, shape (n, 3) [m].
        intensity: shape (n,); nan without the channel.
        covariance: xx, xy, xz, yy, yz, zz, shape (n, 6) [m²].
        shots: number of ranges, with those without a point.
        without_return: shots that returned no range.
        unlocated: shots at which the mirror's angle is unknown.
        geometry: that the points were made with.
        estimator: of the motion.
        limits: reasons why the points are not those of the scene, a line each.
        notes: what a reader has to know, a line each.
        seconds: computing time.
    """

    time: Array
    position: Array
    intensity: Array
    covariance: Array
    shots: int
    without_return: int
    unlocated: int
    geometry: Geometry
    estimator: str
    limits: list[str]
    notes: list[str]
    seconds: float = 0.0

    def summary(self) -> dict[str, Any]:
        """Content of summary.json."""
        sd = np.sqrt(self.covariance[:, [0, 3, 5]])
        return {
            "estimator": self.estimator,
            "points": self.time.size,
            "shots": self.shots,
            "without_return": self.without_return,
            "unlocated": self.unlocated,
            "extent_m": {name: [self.position[:, k].min(), self.position[:, k].max()] for k, name in enumerate("xyz")},
            "largest_distance_m": np.linalg.norm(self.position, axis=1).max(),
            "sd_m": {name: np.sqrt(np.mean(np.square(sd[:, k]))) for k, name in enumerate("xyz")},
            "range_sd_m": self.geometry.range_sd or None,
            "geometry": self.geometry.kind,
            "limits": self.limits,
            "notes": self.notes,
            "seconds": self.seconds,
        }


def make_point_cloud(recording: Recording, options: Options, quiet: bool = False) -> PointCloud:
    """Estimate the mirror's motion and locate the point of every range.

    Args:
        recording: with a channel ``range``, and the channels that the estimator needs.
        options: device, estimator and flips are used.
        quiet: show no progress.

    Raises:
        BadInput: no ranges, none with a return, or the motion cannot be estimated.
    """
    began = time.perf_counter()
    shots = recording.require("range", "a point cloud needs it")
    if len(shots.shape) != 1:
        raise BadInput(f"has the shape {shots.shape}", channel="range", hint="one range a shot is needed, shape (n,)")
    if not _returned(shots.read()).any():
        hint = "ranges are positive numbers in metres, and nan where there was no return"
        raise BadInput("holds no usable return", file=recording.path, channel="range", hint=hint)
    stated = recording.channels.get("intensity")
    if stated is None:
        check_signal(shots, gaps_ok=True)
    channels = {**recording.channels, "intensity": replace(shots, name="intensity")}
    if stated is not None and _same_clock(stated, shots):
        channels["intensity"] = stated
    prepared = prepare(replace(recording, channels=channels), options.device)
    sensor_notes = check_sensor_noise(prepared.recording, prepared.device, options.estimator)
    estimated = correct_readout_phase(estimate_motion(prepared, options), options)
    cut = prepared.recording["range"]
    distance = cut.read()
    returned = _returned(distance)
    located = np.ones(distance.size, bool)
    for first, stop in unlocated_samples(estimated.motion, estimated.beam, prepared.defects, prepared.intensity):
        located[first:stop] = False
    kept = np.flatnonzero(returned & located)
    if not kept.size:
        span = f"from {cut.start:.4g} to {cut.start + cut.size / cut.sample_rate:.4g} s"
        hint = "compare its start with those of the motion's channels, which lissajous info lists"
        raise BadInput(f"has no return at a known angle of the mirror {span}", channel="range", hint=hint)
    geometry = prepared.device.geometry or Geometry()
    angles = {axis: estimated.beam.axes[axis].angle.read()[kept] for axis in AXES}
    when = cut.start + kept / cut.sample_rate
    notes = [*prepared.unknown_entries, *sensor_notes, *estimated.motion_notes]
    notes += _notes(geometry, prepared.device.geometry is None, distance, estimated)
    return PointCloud(
        time=when,
        position=locate_points(geometry, angles["x"], angles["y"], distance[kept]),
        intensity=_intensity_at(stated, when),
        covariance=_covariance(geometry, angles, distance[kept], estimated, when),
        shots=distance.size,
        without_return=int(np.count_nonzero(~returned)),
        unlocated=int(np.count_nonzero(returned & ~located)),
        geometry=geometry,
        estimator=estimated.motion.estimator,
        limits=describe_range_timing(recording, estimated.beam, cut),
        notes=notes,
        seconds=time.perf_counter() - began,
    )


def _returned(distance: Array) -> NDArray[np.bool_]:
    """Which shots returned a range, shape (n,)."""
    return np.isfinite(distance) & (distance > 0.0)


def _same_clock(a: Channel, b: Channel) -> bool:
    """Whether the samples of two channels are taken at the same times."""
    return a.size == b.size and a.sample_rate == b.sample_rate and abs(a.start - b.start) * a.sample_rate < 1e-6


def _intensity_at(channel: Channel | None, when: Array) -> Array:
    """Intensity of the nearest sample, averaged over detectors; nan without the channel and outside of it."""
    if channel is None:
        return np.full(when.size, np.nan)
    values = channel.read()
    values = values if values.ndim == 1 else values.mean(axis=1)
    index = np.round((when - channel.start) * channel.sample_rate).astype(np.int64)
    inside = (index >= 0) & (index < values.size)
    return np.where(inside, values[np.clip(index, 0, values.size - 1)], np.nan)


def _covariance(
    geometry: Geometry, angles: dict[str, Array], distance: Array, estimated: EstimatedMotion, when: Array
) -> Array:
    """Covariance of each point from those of both angles and of the range, shape (n, 6) [m²]."""
    _, direction, _ = trace_rays(geometry, angles["x"], angles["y"])
    sources = [geometry.range_sd * direction]
    for axis in AXES:
        step = {name: ANGLE_STEP_RAD * (name == axis) for name in AXES}
        ahead, behind = (
            locate_points(geometry, angles["x"] + sign * step["x"], angles["y"] + sign * step["y"], distance)
            for sign in (1.0, -1.0)
        )
        sd = _angle_sd(estimated.motion.axes[axis], angles[axis], when)
        sources.append((ahead - behind) / (2.0 * ANGLE_STEP_RAD) * sd[:, None])
    pairs = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
    return np.stack([sum(source[:, i] * source[:, j] for source in sources) for i, j in pairs], axis=1)


def _angle_sd(axis: AxisMotion, angle: Array, when: Array) -> Array:
    """Standard deviation of the angle by phase, amplitude and the noise of single samples, shape (n,) [rad]."""
    amplitude, phase_sd = (np.interp(when, axis.time, values) for values in (axis.amplitude, axis.phase_sd))
    by_phase = phase_sd * np.sqrt(np.maximum(np.square(amplitude) - np.square(angle), 0.0))
    by_both = np.hypot(by_phase, axis.angle_noise_sd)
    if axis.amplitude_sd is None:
        return by_both
    return np.hypot(by_both, angle / amplitude * np.interp(when, axis.time, axis.amplitude_sd))


def _notes(geometry: Geometry, assumed: bool, distance: Array, estimated: EstimatedMotion) -> list[str]:
    notes = []
    if assumed:
        notes.append("the device states no [geometry]: one mirror, the beam along its normal, no lens")
    if not geometry.range_sd:
        notes.append("[geometry] states no range_sd: the covariance holds the part of the angles alone")
    if (farthest := float(distance[_returned(distance)].max())) > MAX_RANGE_M:
        notes.append(f"range: reaches {farthest:.4g} m; if these are millimetres, state the unit mm")
    if farthest < MIN_RANGE_M:
        notes.append(f"range: reaches {farthest:.3g} m only; it is a distance in metres, not a time of flight")
    if (rail := upper_rail(distance[np.isfinite(distance)])) is not None:
        notes.append(
            f"range: {rail[1] / distance.size:.0%} of the values are exactly {rail[0]:.6g} m, the largest one: if that "
            "stands for no return, store nan in its place"
        )
    for what, left_out in (("of 0 or less", distance <= 0.0), ("of infinity", distance == np.inf)):
        if count := int(np.count_nonzero(left_out)):
            notes.append(f"range: {counted(count, 'value')} {what}, taken as no return")
    for axis in AXES:
        if estimated.motion.axes[axis].sign.startswith("ambiguous"):
            notes.append(f"the sign of {axis} is not known: --flip-{axis} mirrors the points")
    return notes
