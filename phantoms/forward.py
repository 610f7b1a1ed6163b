"""The forward simulation: a device, its drive and a scene give a recording with its truth.

Numerics: Runge-Kutta at several steps a sample, the drive evaluated exactly at every stage, the readout's low-pass
sections stepped on the same fine clock. Nothing here is shared with an estimator's own step.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phantoms.optics import Detector, detect, sample
from phantoms.waveforms import Waveform
from scanner.device import Amdm, Axis, Device, Position, Readout, Transimpedance
from scanner.drift import Drift
from scanner.errors import BadInput, DeviceInvalid
from scanner.integrate import rk4
from scanner.laws import amdm_voltage, capacitance, capacitance_slope, position_voltage, transimpedance_voltage
from scanner.lowpass import lowpass, step_coefficients
from scanner.optics import place, recorded
from scanner.recording import Recording

Array = NDArray[np.float64]

CHUNK = 0.01  # seconds integrated at a time: memory stays flat, whatever the length


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
    substeps: int = 4
    settle: float = 0.05
    drift: Mapping[str, Drift] = field(default_factory=dict)
    sense_range: float = 10.0
    angles: bool = False


def trajectory(axis: Axis, plan: Plan, start: Start, t0: float, t1: float) -> tuple[Array, Array]:
    """Angle [rad] and rate [rad/s] from ``t0`` to ``t1`` inclusive on the fine clock of ``plan``.

    Returns:
        two arrays of shape (n substeps + 1,), n samples between t0 and t1.
    """
    mechanics, drive = axis.require_mechanics(), axis.require_drive()
    drift = plan.drift.get(axis.name, Drift())
    n = round((t1 - t0) * plan.sample_rate) * plan.substeps
    step = 1.0 / (plan.sample_rate * plan.substeps)
    time = t0 + 0.5 * step * np.arange(2 * n + 1)
    voltage = plan.drives[axis.name](time) * drift.drive(time)
    comb = axis.capacitance
    electrostatic = drive.kind == "electrostatic"
    C0, theta0, theta_th = (comb.C0, comb.theta0, comb.theta_th) if comb and electrostatic else (0.0, 1.0, 0.0)
    return rk4(
        start.angle,
        start.rate,
        voltage,
        mechanics.b * drift.damping(time),
        mechanics.k * drift.stiffness(time),
        step,
        1,
        mechanics.J,
        C0,
        theta0,
        theta_th,
        0.0 if electrostatic else drive.torque_per_volt,
    )


def settled(axis: Axis, plan: Plan, kick: float = 0.15) -> Start:
    """The state at t = 0 after the drive has run for ``plan.settle`` seconds from an angle of ``kick`` [rad].

    The large branch of a parametric resonance is reached from a large angle only; a drive that cannot hold it
    lets the motion die.
    """
    start = Start(kick, 0.0)
    chunks = max(1, int(np.ceil(plan.settle / CHUNK)))
    edges = -plan.settle + plan.settle * np.arange(chunks + 1) / chunks
    for t0, t1 in pairwise(edges):
        angle, rate = trajectory(axis, plan, start, float(t0), float(t1))
        start = Start(float(angle[-1]), float(rate[-1]))
    if np.abs(angle).max() < 1e-3:
        raise BadInput(
            f"the drive does not sustain a motion: {np.abs(angle).max():.1e} rad are left after {plan.settle:g} s",
            channel=f"drive_{axis.name}",
            hint="drive near twice the resonance, above the threshold 2/Q, or record a ringdown",
        )
    return start


def sense_voltage(
    readout: Readout,
    axes: Mapping[str, Axis],
    angle: Mapping[str, Array],
    rate: Mapping[str, Array],
    step: float,
    memory: dict[int, tuple[float, float]],
) -> Array:
    """Noiseless readout on the fine clock; ``memory`` carries the low-pass sections from chunk to chunk.

    Several axes at once stand for combs that share one electrode: their capacitances add.
    """
    match readout:
        case Amdm():
            signal = np.zeros(next(iter(angle.values())).size)
            for name, axis in axes.items():
                comb = axis.require_capacitance()
                signal += capacitance(angle[name], comb.C0, comb.Cb, comb.theta0, comb.theta_th)
            for i, cutoff in enumerate(readout.lpf_hz):
                first = memory.get(i, (signal[0], signal[0]))
                memory[i] = lowpass(signal, *step_coefficients(cutoff, step), *first)
            return amdm_voltage(signal, readout.a_cir, readout.b_cir)
        case Transimpedance():
            signal = np.zeros(next(iter(angle.values())).size)
            for name, axis in axes.items():
                comb = axis.require_capacitance()
                slope = capacitance_slope(angle[name], comb.C0, comb.theta0, comb.theta_th)
                signal += transimpedance_voltage(slope, rate[name], readout.R_s, readout.V_bias)
            return signal
        case Position():
            if len(axes) > 1:
                raise DeviceInvalid(
                    "a position sensor reads one axis", channel="readout", hint="give each axis its own"
                )
            (name,) = axes
            return position_voltage(angle[name], readout.gain, readout.offset)


def quantised(values: Array, bits: int | None, full_range: float) -> Array:
    """Values as a converter of ``bits`` over +- full_range / 2 gives them."""
    if bits is None:
        return values
    lsb = full_range / 2**bits
    return np.clip(np.round(values / lsb), -(2 ** (bits - 1)), 2 ** (bits - 1) - 1) * lsb


def readouts(device: Device) -> dict[str, tuple[Readout, dict[str, Axis]]]:
    """Sense channels of the device, each with its readout and the axes that it sees."""
    if device.readout is not None:
        return {"sense": (device.readout, dict(device.axes))}
    return {f"sense_{name}": (axis.readout, {name: axis}) for name, axis in device.axes.items() if axis.readout}


def _chunks(plan: Plan) -> Iterator[tuple[float, float]]:
    samples = round(plan.duration * plan.sample_rate)
    per_chunk = round(CHUNK * plan.sample_rate)
    for first in range(0, samples, per_chunk):
        yield first / plan.sample_rate, min(first + per_chunk, samples) / plan.sample_rate


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

    Returns:
        the recording and the content of its ``/truth``: ``angle_x``, ``angle_y`` at every sample, and ``scene``.
    """
    rng = np.random.default_rng(seed)
    state = dict(start) if start else {name: settled(axis, plan) for name, axis in device.axes.items()}
    memory: dict[str, dict[int, tuple[float, float]]] = {}
    parts: dict[str, list[Array]] = {}
    step = 1.0 / (plan.sample_rate * plan.substeps)
    for t0, t1 in _chunks(plan):
        angle, rate = {}, {}
        for name, axis in device.axes.items():
            angle[name], rate[name] = trajectory(axis, plan, state[name], t0, t1)
            state[name] = Start(float(angle[name][-1]), float(rate[name][-1]))
            parts.setdefault(f"angle_{name}", []).append(angle[name][: -1 : plan.substeps])
        for channel, (readout, axes) in readouts(device).items():
            clean = sense_voltage(
                readout,
                axes,
                {a: angle[a][:-1] for a in axes},
                {a: rate[a][:-1] for a in axes},
                step,
                memory.setdefault(channel, {}),
            )[:: plan.substeps]
            noisy = clean + rng.normal(0.0, readout.noise_sd, clean.size)
            parts.setdefault(channel, []).append(quantised(noisy, readout.bits, plan.sense_range))
    truth = {name: np.concatenate(values) for name, values in parts.items() if name.startswith("angle_")}
    channels: dict[str, tuple[NDArray[Any], str]] = {
        name: (np.concatenate(values), "V") for name, values in parts.items() if name.startswith("sense")
    }
    if plan.angles:
        channels |= {name: (values, "rad") for name, values in truth.items()}
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
