"""The forward simulation: a device, its drive and a scene give a recording with its truth.

One chain of physics, ``scanner.response``, with whatever terms the device states; here are the drive, exact at every
stage of a step, what drifts, the noise and the converter. Nothing is shared with an estimator's own step.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from phantoms.optics import Detector, detect, sample
from phantoms.waveforms import Waveform
from scanner.device import Amdm, Axis, Device, Position, Readout
from scanner.drift import Drift
from scanner.errors import BadInput, DeviceInvalid
from scanner.optics import place, recorded
from scanner.recording import Recording
from scanner.response import Added, Inputs, Path, added_terms, move, move_all, reference, sense
from scanner.terms import Term
from scanner.trajectory import TORQUE, thirds

Array = NDArray[np.float64]

CHUNK = 0.01  # seconds integrated at a time: memory stays flat, whatever the length
KICK = 0.15  # rad: where a motion starts that the drive is to sustain
DRIFT_STEP = 2e-6  # seconds between the knots of a drift
FORGOTTEN = 20.0  # time constants


@dataclass(frozen=True)
class Scene:
    """What lies under the beam.

    Attributes:
        light: reflectance in [0, 1] over the whole field, beam spot included, shape (H, W).
        detector: that turns light into the intensity channel.
    """

    light: Array
    detector: Detector


@dataclass(frozen=True)
class Start:
    """State of one axis at the recording's first sample: angle [rad] and rate [rad/s]."""

    angle: float
    rate: float


@dataclass(frozen=True)
class Plan:
    """How one recording is made.

    Attributes:
        drives: voltage of each axis's drive, by axis name.
        duration: of the recording [s].
        sample_rate: of every channel [Hz].
        substeps: Runge-Kutta steps a sample.
        settle: time that the drives have been running before the recording starts [s].
        drift: by axis name; from the recording's start on.
        sense_range: full scale of the converter of the sense channels [V], centred on 0.
        angles: write the true angles as reference channels ``angle_x``, ``angle_y`` too.
    """

    drives: Mapping[str, Waveform]
    duration: float
    sample_rate: float = 5e6
    substeps: int = 2
    settle: float = 0.05
    drift: Mapping[str, Drift] = field(default_factory=dict)
    sense_range: float = 10.0
    angles: bool = False


def drive_inputs(axis: Axis, plan: Plan, t0: float, t1: float) -> Inputs:
    """The drive of one axis from ``t0`` to ``t1`` [s] on the fine clock of ``plan``, exact at every stage of a step."""
    n = round((t1 - t0) * plan.sample_rate) * plan.substeps
    step = 1.0 / (plan.sample_rate * plan.substeps)
    time = t0 + 0.5 * step * np.arange(2 * n + 1)
    voltage = plan.drives[axis.name](time) * plan.drift.get(axis.name, Drift()).drive(time)
    return Inputs(thirds(voltage), step, t0)


def drifting(drift: Drift, t0: float, t1: float) -> tuple[Added, ...]:
    """A drift of stiffness and damping from ``t0`` to ``t1`` [s] as a term, none where there is none.

    The term holds a table, so it is none for a device file.
    """
    knots = np.linspace(t0, t1, max(2, round((t1 - t0) / DRIFT_STEP) + 1))
    table = np.stack([drift.stiffness(knots) - 1.0, drift.damping(knots) - 1.0], axis=1)
    if not table.any():
        return ()
    return (Added(_DRIFT, (t0, (t1 - t0) / (knots.size - 1), float(knots.size), *table.ravel().tolist())),)


@njit(TORQUE, cache=True)
def _drift_torque(t, theta, omega, other, volt, z0, z1, p, nominal):  # type: ignore[no-untyped-def]
    at = (t - p[0]) / p[1]
    i = 3 + 2 * min(max(int(at), 0), int(p[2]) - 2)
    u = at - (i - 3) // 2
    stiffness, damping = p[i] + u * (p[i + 2] - p[i]), p[i + 1] + u * (p[i + 3] - p[i + 1])
    return -stiffness * nominal[2] * theta - damping * nominal[1] * omega, 0.0, 0.0


_DRIFT = Term("drift", "mechanics", "J θ'' + b(t) θ' + k(t) θ = τ", (), "a plan's own", torque=_drift_torque)


def travel(
    axes: Mapping[str, Axis], plan: Plan, start: Mapping[str, Start], edges: Sequence[float]
) -> Iterator[dict[str, Path]]:
    """The motion of all axes with their terms, from one of ``edges`` [s] to the next, on the fine clock of ``plan``."""
    terms = {name: added_terms(axis) for name, axis in axes.items()}
    coupled = any(each.term.coupled for added in terms.values() for each in added)
    state = {name: (each.angle, each.rate) for name, each in start.items()}
    for t0, t1 in pairwise(edges):
        drifts = {name: drifting(drift, t0, t1) for name, drift in plan.drift.items()}

        def moved(name: str, inputs: Inputs, at: tuple[float, float], other: Array | None, drifts=drifts) -> Path:  # type: ignore[no-untyped-def]
            return move(axes[name], (*terms[name], *drifts.get(name, ())), inputs, at, other)

        inputs = {name: drive_inputs(axis, plan, t0, t1) for name, axis in axes.items()}
        paths = move_all(inputs, state, coupled, moved)
        state = {name: (float(path.angle[-1]), float(path.rate[-1])) for name, path in paths.items()}
        yield paths


def trajectory(axis: Axis, plan: Plan, start: Start, t0: float, t1: float) -> Path:
    """The motion of one axis from ``t0`` to ``t1`` inclusive, in one piece."""
    (path,) = next(travel({axis.name: axis}, plan, {axis.name: start}, (t0, t1))).values()
    return path


def settled(axis: Axis, plan: Plan) -> Start:
    """The state at t = 0 after the drive has run for ``plan.settle`` seconds from an angle of ``KICK``.

    The large branch of a parametric resonance is reached from a large angle only; a drive that cannot hold it
    lets the motion die.
    """
    chunks = max(1, int(np.ceil(plan.settle / CHUNK)))
    edges = -plan.settle + plan.settle * np.arange(chunks + 1) / chunks
    *_, paths = travel({axis.name: axis}, plan, {axis.name: Start(KICK, 0.0)}, edges.tolist())
    path = paths[axis.name]
    _require_motion(axis.name, path.angle, plan)
    return Start(float(path.angle[-1]), float(path.rate[-1]))


def _require_motion(axis: str, angle: Array, plan: Plan) -> None:
    left = np.abs(angle).max()
    if left < 1e-3:
        raise BadInput(
            f"the drive does not sustain a motion: {left:.1e} rad are left after {plan.settle:g} s",
            channel=f"drive_{axis}",
            hint="drive near twice the resonance, above the threshold 2/Q, or record a ringdown",
        )


def quantised(values: Array, bits: int | None, full_range: float) -> Array:
    """Values as a converter of ``bits`` over +- full_range / 2 gives them."""
    if bits is None:
        return values
    lsb = full_range / 2**bits
    return np.clip(np.round(values / lsb), -(2 ** (bits - 1)), 2 ** (bits - 1) - 1) * lsb


def readouts(device: Device) -> dict[str, tuple[Readout, tuple[str, ...]]]:
    """Sense channels of the device, each with its readout and the axes that it sees.

    Raises:
        DeviceInvalid: a position sensor for several axes.
    """
    if isinstance(device.readout, Position) and len(device.axes) > 1:
        raise DeviceInvalid("a position sensor reads one axis", channel="readout", hint="give each axis its own")
    if device.readout is not None:
        return {"sense": (device.readout, tuple(device.axes))}
    return {f"sense_{name}": (axis.readout, (name,)) for name, axis in device.axes.items() if axis.readout}


def _pieces(device: Device, plan: Plan, start: Mapping[str, Start] | None) -> Iterator[dict[str, Path]]:
    """The motion of all axes over the recording, piece by piece.

    A term may look at the whole of a signal (its mean, what came before): with terms there is one piece, which takes
    the settling in.
    """
    axes = {name: device.sensed_axis(name) for name in device.axes}
    if not any(axis.terms for axis in axes.values()):
        edges = [*np.arange(0.0, plan.duration, CHUNK).tolist(), plan.duration]
        yield from travel(axes, plan, start or {name: settled(axis, plan) for name, axis in axes.items()}, edges)
        return
    before = 0.0 if start else plan.settle
    state = start or dict.fromkeys(axes, Start(KICK, 0.0))
    (paths,) = travel(axes, plan, state, (-before, plan.duration))
    first = round(before * plan.sample_rate) * plan.substeps
    if first:
        for name, path in paths.items():
            _require_motion(name, path.angle[max(0, first - round(CHUNK / path.inputs.step)) : first], plan)
    yield {name: path.after(first) for name, path in paths.items()}


def _lead(readout: Readout, step: float) -> int:
    """Steps after which a readout's sections have forgotten what they began with."""
    slowest = min(readout.lpf_hz, default=np.inf) if isinstance(readout, Amdm) else np.inf
    return int(np.ceil(FORGOTTEN / (2 * np.pi * slowest * step)))


def simulate(
    device: Device,
    plan: Plan,
    scene: Scene | None = None,
    seed: int = 0,
    start: Mapping[str, Start] | None = None,
    nominal: Device | None = None,
) -> tuple[Recording, dict[str, object]]:
    """One recording and its truth.

    Args:
        device: the true device.
        scene: what the beam sees; without one there is no intensity channel.
        seed: of all noise.
        start: state of each axis at the first sample; by default that of a settled drive.
        nominal: the device that the recording is given, where its calibration differs from the truth.

    Raises:
        BadInput: the plan holds less than two samples, or the device lacks what it needs.

    Returns:
        the recording and the content of its ``/truth``: ``angle_x``, ``angle_y`` at every sample, and ``scene``.
    """
    if round(plan.duration * plan.sample_rate) < 2:
        what = f"{plan.duration:g} s at {plan.sample_rate:g} samples a second make no recording"
        raise BadInput(what, hint="simulate for longer, or faster")
    rng = np.random.default_rng(seed)
    parts: dict[str, list[Array]] = {}
    lead: dict[str, Path] = {}
    for paths in _pieces(device, plan, start):
        for name, path in paths.items():
            parts.setdefault(f"truth_{name}", []).append(path.angle[: -1 : plan.substeps])
            if plan.angles:
                parts.setdefault(f"angle_{name}", []).append(reference(path)[: -1 : plan.substeps])
        for channel, (readout, axes) in readouts(device).items():
            seen = [lead[name].followed_by(paths[name]) if name in lead else paths[name] for name in axes]
            new = len(paths[axes[0]].inputs.voltage)
            clean = sense(readout, seen)[-1 - new : -1 : plan.substeps]
            noisy = clean + rng.normal(0.0, readout.noise_sd, clean.size)
            parts.setdefault(channel, []).append(quantised(noisy, readout.bits, plan.sense_range))
            for name, path in zip(axes, seen, strict=True):
                steps = len(path.inputs.voltage)
                lead[name] = path.after(max(0, steps - _lead(readout, path.inputs.step)))
    whole = {name: np.concatenate(values) for name, values in parts.items()}
    truth = {f"angle_{name}": whole.pop(f"truth_{name}") for name in device.axes}
    channels: dict[str, tuple[NDArray[Any], str]] = {
        name: (values, "rad" if name.startswith("angle") else "V") for name, values in whole.items()
    }
    time = np.arange(round(plan.duration * plan.sample_rate)) / plan.sample_rate
    channels |= {f"drive_{name}": (drive(time), "V") for name, drive in plan.drives.items()}
    told: dict[str, object] = {
        name: (values.astype(np.float32), {"unit": "rad", "sample_rate": plan.sample_rate, "start": 0.0})
        for name, values in truth.items()
    }
    if scene is not None:
        field_of_view = device.require_scan()
        x, y = (place(device, name, truth[f"angle_{name}"], time) for name in ("x", "y"))
        light = sample(scene.light, x, y, field_of_view.half_angle_x, field_of_view.half_angle_y)
        light = recorded(device, light, time)
        channels["intensity"] = (detect(light, plan.sample_rate, scene.detector, rng), "V")
        told["scene"] = scene.light.astype(np.float32)
    recording = Recording.from_arrays(
        {name: (values.astype(np.float32), unit, plan.sample_rate, 0.0) for name, (values, unit) in channels.items()},
        device=nominal or device,
        name=device.name,
    )
    return recording, told
