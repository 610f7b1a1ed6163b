"""``diagnose --plan``: what a measurement could tell of a device before anybody makes it.

The nominal device is played through every planned excitation; around that motion, and under the noise that is stated,
every effect's size and its distance to its nearest look-alike follow to first order. Several excitations are judged
together, as their recordings would be.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from phantoms import waveforms
from phantoms.waveforms import Constant, Multisine, Sine, Sweep, Waveform
from recon.convert import open_any
from recon.output import check_folder, replacing_folder
from scanner.device import Device
from scanner.device_toml import checked_number
from scanner.errors import BadInput
from scanner.files import read_toml
from scanner.recording import Recording

if TYPE_CHECKING:
    from estimation.mismatch.experiment import Run
    from estimation.mismatch.sensitivity import Visible

SCHEMA = "lissajous-plan/1"

KINDS: dict[str, tuple[str, ...]] = {
    "ringdown": ("angle",),
    "steady": ("frequency", "amplitude"),
    "sweep": ("f0", "f1", "amplitude"),
    "steps": ("levels",),
    "multisine": ("frequencies", "amplitude"),
}
"""Kinds of excitation, and what each needs beside the ``offset`` [V] and the ``angle`` [rad] that all may have."""

LISTS = ("levels", "frequencies")


@dataclass(frozen=True)
class Excitation:
    """One planned recording.

    Attributes:
        name: of it.
        drives: voltage, by axis.
        angles: where an axis starts, at rest [rad]; one that is not listed has been driven for a while.
        duration: [s]. sample_rate: of every channel [Hz].
        angle_noise: standard deviation of recorded angles [rad], None where no angle is recorded.
    """

    name: str
    drives: Mapping[str, Waveform]
    angles: Mapping[str, float]
    duration: float
    sample_rate: float
    angle_noise: float | None = None


def read_excitation(path: Path) -> Excitation:
    """The excitation in a TOML file: ``duration``, ``sample_rate``, perhaps ``angle_noise``, and a table an axis.

    Raises:
        BadInput: the file cannot be read, or a key is missing, unknown or holds what it cannot.
    """
    table = read_toml(path)
    try:
        duration, rate = (_number(table, name, "be a number greater than 0") for name in ("duration", "sample_rate"))
        noise = _number(table, "angle_noise", "be a number greater than 0") if "angle_noise" in table else None
        axes: dict[str, Any] = {name: table.pop(name) for name in ("x", "y") if name in table}
        _refuse(table, ("duration", "sample_rate", "angle_noise", "x", "y"), "")
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


def _refuse(table: Mapping[str, Any], known: Sequence[str], where: str) -> None:
    for name in table:
        if name not in known:
            key = f"{where}.{name}" if where else name
            raise BadInput("is no key of an excitation", channel=key, hint=f"there are {', '.join(known)}")


def _waveform(table: object, axis: str, duration: float) -> Waveform:
    """The voltage that one axis's table states."""
    if not isinstance(table, dict):
        raise BadInput("must be a table", channel=axis, hint=f"write [{axis}]")
    kind = table.get("kind")
    if kind not in KINDS:
        hint = f"kinds: {', '.join(KINDS)}"
        raise BadInput(f"is {kind!r}, which is no kind of excitation", channel=f"{axis}.kind", hint=hint)
    _refuse(table, ("kind", "offset", "angle", *KINDS[kind]), axis)
    found: dict[str, Any] = {"offset": 0.0}
    for name in {*KINDS[kind], *(key for key in table if key != "kind")}:
        if name not in table:
            raise BadInput("is missing", channel=f"{axis}.{name}", hint=f"{kind} needs {', '.join(KINDS[kind])}")
        values = table[name] if name in LISTS else [table[name]]
        if not (isinstance(values, list) and values):
            raise BadInput("must be a list of numbers", channel=f"{axis}.{name}")
        numbers = tuple(float(checked_number(v, "be a finite number", f"{axis}.{name}")) for v in values)
        found[name] = numbers if name in LISTS else numbers[0]
    offset = found["offset"]
    match kind:
        case "ringdown":
            return Constant(offset)
        case "steady":
            return Sine(found["frequency"], found["amplitude"], offset)
        case "sweep":
            return Sweep(found["f0"], found["f1"], duration, found["amplitude"], offset)
        case "steps":
            levels = found["levels"]
            return waveforms.Sequence([(Constant(offset + level), duration / len(levels)) for level in levels])
        case _:
            count = len(found["frequencies"])
            phases = tuple(-np.pi * i * i / count for i in range(count))  # low crest: Schroeder, 1970
            return Multisine(found["frequencies"], (found["amplitude"],) * count, phases, offset)


def played(excitation: Excitation, device: Device) -> Recording:
    """The recording that ``device`` would give under an excitation.

    A device whose axes have a readout each may have some of them left at rest; they are not recorded.

    Raises:
        BadInput: the excitation moves an axis that the device lacks, leaves out one that shares its readout, or its
            drive does not sustain a motion.
    """
    from phantoms.forward import Plan, Start, settled, simulate

    for name in excitation.drives:
        device.axis(name)
    missing = [name for name in device.axes if name not in excitation.drives]
    if missing and device.readout is not None:
        raise BadInput("shares its readout and is left out", channel=missing[0], hint="state every axis")
    device = replace(device, axes={name: device.axes[name] for name in excitation.drives})
    plan = Plan(
        excitation.drives, excitation.duration, excitation.sample_rate, angles=excitation.angle_noise is not None
    )
    start = {}
    for name, axis in device.axes.items():
        linear = axis.drive is not None and axis.drive.kind == "linear"
        if name in excitation.angles or linear:
            start[name] = Start(excitation.angles.get(name, 0.0), 0.0)
        else:
            start[name] = settled(device.sensed_axis(name), plan)
    recording, _ = simulate(device, plan, start=start)
    return recording


def planned_run(excitation: Excitation, device: Device) -> Run:
    """An excitation played, ready to be compared with; raises as :func:`played`."""
    from estimation.mismatch.experiment import experiment

    run = experiment(played(excitation, device), device)
    noise = excitation.angle_noise
    outputs = tuple(replace(o, noise_sd=noise) if o.kind == "angle" else o for o in run.outputs)
    return replace(run, name=excitation.name, outputs=outputs)


def what_is_told(runs: Sequence[Run], device: Device) -> list[Visible]:
    """Every effect's size and distance to its nearest look-alike, were ``runs`` recorded of the nominal device.

    Only where the motion starts is taken from the runs' channels.

    Raises:
        BadInput: a readout states no noise.
    """
    from estimation.mismatch.fit import Comparison
    from estimation.mismatch.model import Model
    from estimation.mismatch.sensitivity import linearised, stated_whitener, visibility
    from estimation.mismatch.start import started, windows
    from scanner.terms import catalogue

    whiteners = [[stated_whitener(output) for output in run.outputs] for run in runs]
    model = Model(runs, device)
    begun = started(Comparison(runs, whiteners), model, windows(model)[0])
    x = np.array([v if f.kind == "start" else 0.0 for f, v in zip(model.free, begun.x, strict=True)])
    comparison, fit = linearised(model, x, whiteners)
    return visibility(comparison, fit, catalogue().values())


def plan_files(
    paths: Sequence[Path],
    output: Path,
    device: Path | None = None,
    mapping: Path | None = None,
    quiet: bool = False,
) -> dict[str, Any]:
    """Judge planned excitations (``.toml``), and recordings in their place; write plan.json and report.html.

    Args:
        device: name or file; by default that of the first recording.

    Raises:
        BadInput: an excitation, a recording or the device cannot be used.
    """
    from tqdm import tqdm

    from estimation.mismatch.experiment import experiment
    from phantoms.experiment import device_named
    from recon.diagnosis_report import plan_report

    check_folder(output)
    planned = {path: read_excitation(path) for path in paths if path.suffix == ".toml"}
    with ExitStack() as stack, tqdm(disable=quiet, bar_format="{elapsed} {desc}", leave=False) as bar:
        recorded = {path: stack.enter_context(open_any(path, mapping)) for path in paths if path.suffix != ".toml"}
        nominal = device_named(str(device)) if device is not None else None
        nominal = nominal or next((each.device for each in recorded.values() if each.device is not None), None)
        if nominal is None:
            raise BadInput("states no device", file=paths[0], hint="give one with --device")
        runs = []
        for path in paths:
            bar.set_description_str(f"playing {path.name}")
            runs.append(planned_run(planned[path], nominal) if path in planned else experiment(recorded[path], nominal))
        bar.set_description_str("every effect of the catalogue")
        told = what_is_told(runs, nominal)
        content = plan_content(runs, nominal, told)
        with replacing_folder(output) as folder:
            text = json.dumps(content, indent=1, ensure_ascii=False)
            (folder / "plan.json").write_text(text + "\n", encoding="utf-8")
            (folder / "report.html").write_text(plan_report(content, told), encoding="utf-8")
    return content | {"output": str(output)}


def plan_content(runs: Sequence[Run], device: Device, told: Sequence[Visible]) -> dict[str, Any]:
    """The content of plan.json."""
    from estimation.mismatch.sensitivity import APART

    return {
        "schema": SCHEMA,
        "device": device.name,
        "excitations": [
            {"name": run.name, "duration": run.duration, "channels": [output.name for output in run.outputs]}
            for run in runs
        ],
        "apart": APART,
        "effects": [
            {
                "axis": each.candidate.axis,
                "stage": each.candidate.term.stage,
                "effect": each.candidate.term.effect,
                "channel": each.candidate.channel,
                "sigma": each.sigma,
                "nearest": each.nearest.key,
                "distance": each.distance,
                "advice": each.candidate.term.lookalikes.get(each.nearest.term.effect)
                if each.distance < APART
                else None,
            }
            for each in told
        ],
    }
