"""The forward simulation: a device, its drives and a scene give a recording with its truth.

``scanner.forward_model`` computes the physics, with all terms that the device states. This module adds the exact drive
at the nodes of every step, drifts, noise and the converter. It shares no code with the estimators.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from math import ceil
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phantoms.drift_term import drift_terms
from phantoms.optics import Detector, detect, sample_scene
from phantoms.sense_channels import quantise, sense_channels
from phantoms.waveforms import Waveform
from scanner.active_terms import ActiveTerm, check_effects, stated_terms
from scanner.arrays import Array
from scanner.channel import CHANNEL_UNITS
from scanner.coupled_motion import simulate_coupled
from scanner.device import Axis, Device
from scanner.drift import Drift
from scanner.errors import BadInput
from scanner.forward_model import AxisTrajectory, DriveInput, reference_signal, sense_signal, simulate_axis
from scanner.integrator.nodes import to_nodes
from scanner.optics import apply_intensity_terms, beam_position
from scanner.recording import Recording
from scanner.settling import settling_time
from scanner.stages import without_noise

CHUNK_S = 0.01
"""Length integrated at a time [s]: 2 MB an axis at 10 MHz, so memory does not grow with the recording."""

MIN_STEPS_PER_PERIOD = 8
"""Steps of the integration in a period of the resonance. From 2 on the motion diverges; with 8 its damping is right to
some percent of that of Q = 100."""

START_ANGLE_RAD = 0.15
"""Angle from which a driven motion starts [rad]. The large branch of a parametric resonance is reached only from an
angle near it; the scanners of the papers have amplitudes of 0.1 to 0.2 rad."""

MAX_SAMPLES = 1e8
"""Most samples that are simulated: with 150 bytes each, as measured, they take 15 GB of memory."""

MIN_LEAD_STEPS = 2
"""Steps before a piece that the derivatives of a motion need."""


@dataclass(frozen=True)
class Scene:
    """The sample and the detector of its light.

    Attributes:
        light: reflectance in [0, 1] over the whole field, beam spot included, shape (H, W).
        detector: that turns light into the intensity channel.
    """

    light: Array
    detector: Detector


@dataclass(frozen=True)
class InitialState:
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
        references: kinds of reference channel of every axis that are written too, of
            ``scanner.forward_model.REFERENCE_ORDERS``: ``"angle"``, ``"velocity"``, ``"acceleration"``.
    """

    drives: Mapping[str, Waveform]
    duration: float
    sample_rate: float = 5e6
    substeps: int = 2
    settle: float = 0.05
    drift: Mapping[str, Drift] = field(default_factory=dict)
    sense_range: float = 10.0
    references: tuple[str, ...] = ()


def drive_inputs(axis: Axis, plan: Plan, t0: float, t1: float) -> DriveInput:
    """Return the drive of one axis from ``t0`` to ``t1`` [s], exact at the nodes of the steps of ``plan``."""
    n = round((t1 - t0) * plan.sample_rate) * plan.substeps
    step = 1.0 / (plan.sample_rate * plan.substeps)
    time = t0 + 0.5 * step * np.arange(2 * n + 1, dtype=np.float64)
    voltage = plan.drives[axis.name](time) * plan.drift.get(axis.name, Drift()).drive(time)
    return DriveInput(to_nodes(voltage), step, t0)


def simulate_motion(
    axes: Mapping[str, Axis], plan: Plan, start: Mapping[str, InitialState], edges: Sequence[float]
) -> Iterator[dict[str, AxisTrajectory]]:
    """Yield the motion of all axes with their terms, from one of ``edges`` [s] to the next.

    Raises:
        BadInput: the motion grows without limit.
    """
    terms = {name: stated_terms(axis) for name, axis in axes.items()}
    coupled = any(each.term.couples_motions for added in terms.values() for each in added)
    state = {name: (each.angle, each.rate) for name, each in start.items()}
    for t0, t1 in pairwise(edges):
        drifts = {name: drift_terms(drift, t0, t1) for name, drift in plan.drift.items()}

        all_terms = {name: (*terms[name], *drifts.get(name, ())) for name in axes}

        def simulate_one(
            name: str,
            drive: DriveInput,
            at: tuple[float, float],
            other_angle: Array | None,
            all_terms: Mapping[str, tuple[ActiveTerm, ...]] = all_terms,
        ) -> AxisTrajectory:
            return simulate_axis(axes[name], all_terms[name], drive, at, other_angle)

        drives = {name: drive_inputs(axis, plan, t0, t1) for name, axis in axes.items()}
        paths = simulate_coupled(drives, state, coupled, simulate_one)
        state = {name: (float(path.angle[-1]), float(path.rate[-1])) for name, path in paths.items()}
        for name, reached in state.items():
            if not np.isfinite(reached).all():
                what = f"the simulated motion has diverged at {t1:.3g} s"
                raise BadInput(what, channel=name, hint="check the device, its terms, the drive and the drift")
        yield paths


def simulate_trajectory(axis: Axis, plan: Plan, start: InitialState, t0: float, t1: float) -> AxisTrajectory:
    """Return the motion of one axis from ``t0`` to ``t1`` [s], both included."""
    (path,) = next(simulate_motion({axis.name: axis}, plan, {axis.name: start}, (t0, t1))).values()
    return path


def settled_state(axis: Axis, plan: Plan) -> InitialState:
    """Return the state at t = 0 after the drive has run for ``plan.settle`` seconds from ``START_ANGLE_RAD``.

    Raises:
        BadInput: the drive does not sustain a motion.
    """
    return _last_state(_settling_motion(axis, plan, 0.0))


def _settling_motion(axis: Axis, plan: Plan, duration: float) -> AxisTrajectory:
    """The end of the settling of an axis, of ``duration`` [s] or longer, up to t = 0. Raises as :func:`settled_state`.

    Earlier pieces are dropped, as the settling may be long.
    """
    samples = max(1, round(plan.settle * plan.sample_rate))
    last = min(samples, ceil(max(duration, CHUNK_S) * plan.sample_rate))
    edges = _piece_edges(samples - last, plan.sample_rate, -samples / plan.sample_rate) if samples > last else []
    edges = [*(edges or [-samples / plan.sample_rate]), 0.0]
    pieces = simulate_motion({axis.name: axis}, plan, {axis.name: InitialState(START_ANGLE_RAD, 0.0)}, edges)
    (paths,) = deque(pieces, maxlen=1)
    path = paths[axis.name]
    _require_motion(axis.name, path.angle, plan)
    return path


def _last_state(path: AxisTrajectory) -> InitialState:
    return InitialState(float(path.angle[-1]), float(path.rate[-1]))


def _piece_edges(samples: int, sample_rate: float, start: float = 0.0) -> list[float]:
    """Ends of the pieces of a simulation [s]: at whole samples, so that the motion continues where it stopped.

    Args:
        samples: of the whole simulation.
        sample_rate: [Hz].
        start: of the first piece [s].
    """
    length = max(1, round(CHUNK_S * sample_rate))
    return [start + index / sample_rate for index in (*range(0, samples, length), samples)]


def _require_motion(axis: str, angle: Array, plan: Plan) -> None:
    left = np.abs(angle).max()
    if left < 1e-3:
        raise BadInput(
            f"the drive does not sustain a motion: {left:.1e} rad are left after {plan.settle:g} s",
            channel=f"drive_{axis}",
            hint="drive near twice the resonance, above the threshold 2/Q, or record a ringdown",
        )


def _motion_pieces(
    device: Device, plan: Plan, start: Mapping[str, InitialState] | None, lead: float
) -> Iterator[dict[str, AxisTrajectory]]:
    """The motion of all axes before the recording, of ``lead`` [s] or longer, and over it, piece by piece.

    A term may depend on the whole of a signal (its mean, its history). With terms there is therefore one piece, which
    includes the settling. Nothing precedes a stated ``start``: there the first item is empty.
    """
    axes = {name: device.sensed_axis(name) for name in device.axes}
    if not any(axis.terms for axis in axes.values()):
        before = {} if start else {name: _settling_motion(axis, plan, lead) for name, axis in axes.items()}
        yield before
        edges = _piece_edges(round(plan.duration * plan.sample_rate), plan.sample_rate)
        yield from simulate_motion(
            axes, plan, start or {name: _last_state(path) for name, path in before.items()}, edges
        )
        return
    settling = 0 if start else round(plan.settle * plan.sample_rate)
    state = start or dict.fromkeys(axes, InitialState(START_ANGLE_RAD, 0.0))
    (paths,) = simulate_motion(axes, plan, state, (-settling / plan.sample_rate, plan.duration))
    first = settling * plan.substeps
    if first:
        for name, path in paths.items():
            _require_motion(name, path.angle[max(0, first - round(CHUNK_S / path.drive.step)) : first], plan)
    yield {name: path.to_step(first) for name, path in paths.items()} if first else {}
    yield {name: path.from_step(first) for name, path in paths.items()}


def check_plan(device: Device, plan: Plan, settles: bool = True) -> None:
    """Check what can be checked without a simulation.

    Args:
        device: the true device.
        plan: drives, duration and rates.
        settles: whether the drives run before the recording starts.

    Raises:
        BadInput: the plan holds less than two samples or too many, its steps do not resolve the motion, or the device
            lacks mechanics or a readout that can be simulated, or states a term that has no effect.
    """
    _check_samples(device, plan, settles)
    _check_steps(device, plan)
    sense_channels(device)
    check_effects(device)


def _check_samples(device: Device, plan: Plan, settles: bool) -> None:
    """Check the number of samples that are held in memory; with terms, those of the settling are too.

    Raises:
        BadInput: they are less than two or more than ``MAX_SAMPLES``.
    """
    simulated = f"{plan.duration:g} s at {plan.sample_rate:g} samples a second"
    if plan.duration * plan.sample_rate < 1.5:
        raise BadInput(f"{simulated} make no recording", hint="simulate for longer, or faster")
    terms = any(device.sensed_axis(name).terms for name in device.axes)
    before = plan.settle if settles and terms else 0.0
    if (plan.duration + before) * plan.sample_rate > MAX_SAMPLES:
        simulated += f", after {before:g} s until the motion of this Q has settled," if before else ""
        what = f"{simulated} are {(plan.duration + before) * plan.sample_rate:.2g} samples"
        raise BadInput(what, hint=f"simulate {MAX_SAMPLES:g} at most: a shorter time, or fewer samples a second")


def _check_steps(device: Device, plan: Plan) -> None:
    """Check that the steps of the integration resolve the motion.

    Raises:
        BadInput: they do not.
    """
    for name, axis in device.axes.items():
        frequency = axis.require_mechanics().resonance
        if plan.sample_rate * plan.substeps < MIN_STEPS_PER_PERIOD * frequency:
            least = MIN_STEPS_PER_PERIOD * frequency / plan.substeps
            what = f"{plan.sample_rate:g} samples a second are too few for {name}, of a resonance of {frequency:.6g} Hz"
            raise BadInput(what, hint=f"simulate with {ceil(least)} or more")


def _lead(device: Device, plan: Plan) -> float:
    """Time before a piece on which the channels in it depend [s]."""
    kinds = [("sense", axes) for _, axes in sense_channels(device).values()]
    kinds += [(kind, (name,)) for kind in plan.references for name in device.axes]
    settling = [settling_time(kind, [device.sensed_axis(name) for name in axes])[0] for kind, axes in kinds]
    return max([MIN_LEAD_STEPS / (plan.sample_rate * plan.substeps), *settling])


def _last_part(paths: Mapping[str, AxisTrajectory], duration: float) -> dict[str, AxisTrajectory]:
    """The end of a motion, of ``duration`` [s] or shorter."""
    return {
        name: path.from_step(max(0, len(path.drive.voltage) - ceil(duration / path.drive.step)))
        for name, path in paths.items()
    }


def simulate(
    device: Device,
    plan: Plan,
    scene: Scene | None = None,
    seed: int = 0,
    start: Mapping[str, InitialState] | None = None,
    nominal: Device | None = None,
) -> tuple[Recording, dict[str, object]]:
    """Simulate one recording and its truth.

    Args:
        device: the true device.
        plan: drives, duration and rates.
        scene: without one there is no intensity channel.
        seed: of all noise.
        start: state of each axis at the first sample, before which its signals are constant; by default that of a
            settled drive.
        nominal: the device that the recording states, where its calibration differs from the truth.

    Raises:
        BadInput: the plan holds less than two samples or too many, the device lacks what it needs, or the motion
            diverges.

    Returns:
        the recording and the content of its ``/truth``: ``angle_x``, ``angle_y`` at every sample, and ``scene``.
    """
    check_plan(device, plan, start is None)
    rng = np.random.default_rng(seed)
    parts: dict[str, list[Array]] = {}
    lead = _lead(device, plan)
    pieces = _motion_pieces(device, plan, start, lead)
    before = _last_part(next(pieces), lead)
    for piece in pieces:
        paths = {name: before[name].joined_with(path) if name in before else path for name, path in piece.items()}
        samples = slice(-1 - len(next(iter(piece.values())).drive.voltage), -1, plan.substeps)
        for name, path in paths.items():
            parts.setdefault(f"truth_{name}", []).append(path.angle[samples])
            for kind in plan.references:
                parts.setdefault(f"{kind}_{name}", []).append(reference_signal(path, kind)[samples])
        for channel, (readout, axes) in sense_channels(device).items():
            motions = [paths[name] for name in axes]
            noise = np.zeros(motions[0].angle.size)
            noise[samples] = rng.normal(0.0, readout.noise_sd, noise[samples].size)
            noisy = sense_signal(without_noise(readout), motions, noise)[samples]
            parts.setdefault(channel, []).append(quantise(noisy, readout.bits, plan.sense_range))
        before = _last_part(paths, lead)
    whole = {name: np.concatenate(values) for name, values in parts.items()}
    truth = {f"angle_{name}": whole.pop(f"truth_{name}") for name in device.axes}
    channels: dict[str, tuple[NDArray[Any], str]] = {
        name: (values, CHANNEL_UNITS[name]) for name, values in whole.items()
    }
    time = np.arange(round(plan.duration * plan.sample_rate)) / plan.sample_rate
    channels |= {f"drive_{name}": (drive(time), "V") for name, drive in plan.drives.items()}
    stored_truth: dict[str, object] = {
        name: (values.astype(np.float32), {"unit": "rad", "sample_rate": plan.sample_rate, "start": 0.0})
        for name, values in truth.items()
    }
    if scene is not None:
        field_of_view = device.require_scan()
        x, y = (beam_position(device, name, truth[f"angle_{name}"], time) for name in ("x", "y"))
        light = sample_scene(scene.light, x, y, *field_of_view.mechanical_half_angles)
        light = apply_intensity_terms(device, light, time)
        channels["intensity"] = (detect(light, plan.sample_rate, scene.detector, rng), "V")
        stored_truth["scene"] = scene.light.astype(np.float32)
    recording = Recording.from_arrays(
        {name: (values.astype(np.float32), unit, plan.sample_rate, 0.0) for name, (values, unit) in channels.items()},
        device=nominal or device,
        name=device.name,
    )
    return recording, stored_truth
