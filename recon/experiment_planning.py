"""Planning of experiments (``diagnose --plan``): which effects a planned measurement could detect and distinguish.

The nominal device is simulated under every planned excitation. Around that motion, and with the stated noise, the size
of every effect and its distance to its nearest confounder follow to first order. Several excitations are assessed
together, as their recordings would be.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from phantoms import waveforms
from phantoms.waveforms import Constant, Multisine, Sine, Sweep, Waveform
from recon.io.convert import open_any
from recon.io.output import check_folder, replacing_folder, write_json
from scanner import devices
from scanner.device import Device
from scanner.device_toml import checked_number
from scanner.errors import BadInput
from scanner.files import read_toml
from scanner.recording import Recording

if TYPE_CHECKING:
    from estimation.device_fit.data import Run
    from estimation.diagnosis.identifiability import Detectability

SCHEMA = "lissajous-plan/1"

EXCITATION_KINDS: dict[str, tuple[str, ...]] = {
    "ringdown": ("angle",),
    "steady": ("frequency", "amplitude"),
    "sweep": ("f0", "f1", "amplitude"),
    "steps": ("levels",),
    "multisine": ("frequencies", "amplitude"),
}
"""Keys that each kind of excitation needs. All may also have ``offset`` [V] and ``angle`` [rad]."""

LIST_KEYS = ("levels", "frequencies")
"""Keys whose value is a list of numbers."""


@dataclass(frozen=True)
class Excitation:
    """One planned recording.

    Attributes:
        name: of the recording.
        drives: voltage by axis.
        angles: initial angle by axis, at rest [rad]; an axis that is not listed starts in steady motion.
        duration: [s].
        sample_rate: of every channel [Hz].
        angle_noise: standard deviation of recorded angles [rad]; None where no angle is recorded.
    """

    name: str
    drives: Mapping[str, Waveform]
    angles: Mapping[str, float]
    duration: float
    sample_rate: float
    angle_noise: float | None = None


def read_excitation(path: Path) -> Excitation:
    """Read an excitation from a TOML file: ``duration``, ``sample_rate``, optionally ``angle_noise``, a table per axis.

    Raises:
        BadInput: the file cannot be read, or a key is missing, unknown or has an invalid value.
    """
    table = read_toml(path)
    try:
        duration, rate = (_number(table, name, "be a number greater than 0") for name in ("duration", "sample_rate"))
        noise = _number(table, "angle_noise", "be a number greater than 0") if "angle_noise" in table else None
        axes: dict[str, Any] = {name: table.pop(name) for name in ("x", "y") if name in table}
        _refuse_unknown_keys(table, ("duration", "sample_rate", "angle_noise", "x", "y"), "")
        if not axes:
            raise BadInput("moves no axis", hint="write [x], [y] or both")
        drives = {name: _waveform(axis, name, duration) for name, axis in axes.items()}
        angles = {name: float(axis["angle"]) for name, axis in axes.items() if "angle" in axis}
    except BadInput as error:
        raise BadInput(error.what, file=path, channel=error.channel, hint=error.hint) from None
    return Excitation(path.stem, drives, angles, duration, rate, noise)


def _number(table: dict[str, Any], name: str, must: str, where: str = "") -> float:
    key = f"{where}.{name}" if where else name
    if name not in table:
        raise BadInput("is missing", channel=key, hint="an excitation needs it")
    return float(checked_number(table.pop(name), must, key))


def _refuse_unknown_keys(table: Mapping[str, Any], known: Sequence[str], where: str) -> None:
    for name in table:
        if name not in known:
            key = f"{where}.{name}" if where else name
            raise BadInput("is no key of an excitation", channel=key, hint=f"there are {', '.join(known)}")


def _waveform(table: object, axis: str, duration: float) -> Waveform:
    """The voltage that the table of one axis states."""
    if not isinstance(table, dict):
        raise BadInput("must be a table", channel=axis, hint=f"write [{axis}]")
    kind = table.get("kind")
    if kind not in EXCITATION_KINDS:
        hint = f"kinds: {', '.join(EXCITATION_KINDS)}"
        raise BadInput(f"is {kind!r}, which is no kind of excitation", channel=f"{axis}.kind", hint=hint)
    _refuse_unknown_keys(table, ("kind", "offset", "angle", *EXCITATION_KINDS[kind]), axis)
    parameters: dict[str, Any] = {"offset": 0.0}
    for name in {*EXCITATION_KINDS[kind], *(key for key in table if key != "kind")}:
        if name not in table:
            hint = f"{kind} needs {', '.join(EXCITATION_KINDS[kind])}"
            raise BadInput("is missing", channel=f"{axis}.{name}", hint=hint)
        values = table[name] if name in LIST_KEYS else [table[name]]
        if not (isinstance(values, list) and values):
            raise BadInput("must be a list of numbers", channel=f"{axis}.{name}")
        numbers = tuple(float(checked_number(v, "be a finite number", f"{axis}.{name}")) for v in values)
        parameters[name] = numbers if name in LIST_KEYS else numbers[0]
    offset = parameters["offset"]
    match kind:
        case "ringdown":
            return Constant(offset)
        case "steady":
            return Sine(parameters["frequency"], parameters["amplitude"], offset)
        case "sweep":
            return Sweep(parameters["f0"], parameters["f1"], duration, parameters["amplitude"], offset)
        case "steps":
            levels = parameters["levels"]
            return waveforms.Sequence([(Constant(offset + level), duration / len(levels)) for level in levels])
        case _:
            count = len(parameters["frequencies"])
            phases = tuple(-np.pi * i * i / count for i in range(count))  # low crest factor (Schroeder 1970)
            return Multisine(parameters["frequencies"], (parameters["amplitude"],) * count, phases, offset)


def simulate_excitation(excitation: Excitation, device: Device) -> Recording:
    """Simulate the noiseless recording of a device under an excitation.

    If each axis of the device has its own readout, axes without an excitation are at rest and not recorded.

    Raises:
        BadInput: the excitation moves an axis that the device lacks, it omits an axis that shares its readout, or its
            drive does not sustain a motion.
    """
    from phantoms.forward import InitialState, Plan, settled_state, simulate

    for name in excitation.drives:
        device.axis(name)
    missing = [name for name in device.axes if name not in excitation.drives]
    if missing and device.readout is not None:
        raise BadInput("shares its readout and is left out", channel=missing[0], hint="state every axis")
    device = replace(device, axes={name: device.axes[name] for name in excitation.drives})
    references = ("angle",) if excitation.angle_noise is not None else ()
    plan = Plan(excitation.drives, excitation.duration, excitation.sample_rate, references=references)
    start = {}
    for name, axis in device.axes.items():
        linear = axis.drive is not None and axis.drive.kind == "linear"
        if name in excitation.angles or linear:
            start[name] = InitialState(excitation.angles.get(name, 0.0), 0.0)
        else:
            start[name] = settled_state(device.sensed_axis(name), plan)
    recording, _ = simulate(device, plan, start=start)
    return recording


def prepare_planned_run(excitation: Excitation, device: Device) -> Run:
    """Simulate an excitation and prepare the recording for a fit; raises as :func:`played`."""
    from estimation.device_fit.data import prepare_run

    run = prepare_run(simulate_excitation(excitation, device), device)
    noise = excitation.angle_noise
    outputs = tuple(replace(o, noise_sd=noise) if o.kind == "angle" else o for o in run.outputs)
    return replace(run, name=excitation.name, outputs=outputs)


def predict_detectability(runs: Sequence[Run], device: Device) -> list[Detectability]:
    """Return the size of every effect and its distance to its nearest confounder in recordings of the nominal device.

    Only the initial state of the motion is taken from the channels of the runs.

    Raises:
        BadInput: a readout states no noise.
    """
    from estimation.device_fit.fit import Likelihood, linearise_simulated
    from estimation.device_fit.initial import fit_initial_state, stated_whitener, window_schedule
    from estimation.device_fit.model import Model
    from estimation.diagnosis.identifiability import detectability
    from scanner.terms import catalogue

    whiteners = [[stated_whitener(output) for output in run.outputs] for run in runs]
    model = Model(runs, device)
    begun = fit_initial_state(Likelihood(runs, whiteners), model, window_schedule(model)[0])
    x = np.array([v if f.kind == "start" else 0.0 for f, v in zip(model.parameters, begun.x, strict=True)])
    likelihood, fit = linearise_simulated(model, x, whiteners)
    return detectability(likelihood, fit, catalogue().values())


def plan_files(
    paths: Sequence[Path],
    output: Path,
    device: str | Path | None = None,
    mapping: Path | None = None,
    quiet: bool = False,
) -> dict[str, Any]:
    """Assess planned excitations (``.toml``) and recordings; write plan.json and report.html.

    Args:
        device: name or file; by default that of the first recording.

    Raises:
        BadInput: an excitation, a recording or the device cannot be used.
    """
    from estimation.device_fit.data import prepare_run
    from recon.report.diagnosis import plan_report
    from recon.runtime.stage_progress import stage_progress

    check_folder(output)
    planned = {path: read_excitation(path) for path in paths if path.suffix == ".toml"}
    with ExitStack() as stack, stage_progress(quiet) as progress:
        recorded = {path: stack.enter_context(open_any(path, mapping)) for path in paths if path.suffix != ".toml"}
        nominal = devices.find(device) if device is not None else None
        nominal = nominal or next((each.device for each in recorded.values() if each.device is not None), None)
        if nominal is None:
            raise BadInput("states no device", file=paths[0], hint="give one with --device")
        runs = []
        for path in paths:
            progress(f"playing {path.name}")
            runs.append(
                prepare_planned_run(planned[path], nominal) if path in planned else prepare_run(recorded[path], nominal)
            )
        progress("every effect of the catalogue")
        detectabilities = predict_detectability(runs, nominal)
        content = plan_to_json(runs, nominal, detectabilities)
        with replacing_folder(output) as folder:
            write_json(folder / "plan.json", content)
            (folder / "report.html").write_text(plan_report(content, detectabilities), encoding="utf-8")
    return content | {"output": str(output)}


def plan_to_json(runs: Sequence[Run], device: Device, detectabilities: Sequence[Detectability]) -> dict[str, Any]:
    """Return the content of plan.json."""
    from estimation.diagnosis.identifiability import DISCRIMINATION_SIGMA

    return {
        "schema": SCHEMA,
        "device": device.name,
        "excitations": [
            {"name": run.name, "duration": run.duration, "channels": [output.name for output in run.outputs]}
            for run in runs
        ],
        "apart": DISCRIMINATION_SIGMA,
        "effects": [
            {
                "axis": each.candidate.axis,
                "stage": each.candidate.term.stage,
                "effect": each.candidate.term.effect,
                "channel": each.candidate.channel,
                "key": each.candidate.key,
                "sigma": each.sigma,
                "nearest": each.nearest.key,
                "distance": each.distance,
                "advice": each.candidate.term.confounders.get(each.nearest.term.effect)
                if each.distance < DISCRIMINATION_SIGMA
                else None,
            }
            for each in detectabilities
        ],
    }
