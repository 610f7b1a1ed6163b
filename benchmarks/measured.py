"""Measured recordings with an expected answer: diagnosed, and held against it.

    python -m benchmarks.measured DATA [ROW ...]

DATA is the folder of measured data; rows are the keys of ``ROWS``, all of them where none is
given.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from estimation.device_fit.predict import predict
from estimation.diagnosis.diagnose import diagnose
from scanner.arrays import Array
from scanner.device import Axis, Device
from scanner.recording import Recording
from scanner.stages import Acceleration, Drive, Mechanics, Position

Case = tuple[list[Recording], list[Recording], Device]
"""Recordings to diagnose, recordings to predict with the result, nominal device."""


def _one_axis(name: str, axis: Axis, **channels: tuple[Array, str, float]) -> Recording:
    made = {key: (values, unit, rate, 0.0) for key, (values, unit, rate) in channels.items()}
    return Recording.from_arrays(made, Device(name, {"x": axis}), name)


def _silverbox(data: Path) -> Case:
    variables = np.load(data / "silverbox/multisine.npz")
    drive, sensed = (np.ravel(variables[key]).astype(float) for key in variables.files[:2])
    resonance = 2 * np.pi * 72.0
    axis = Axis(
        Mechanics(1.0, 30.0, resonance**2), drive=Drive("linear", 1.2 * resonance**2), readout=Position(1.0, 3e-4),
        tolerance={"J": 1e-9, "gain": 1e-9, "k": 0.2, "b": 0.5, "torque_per_volt": 0.5}, name="x",
    )  # fmt: skip
    channels = {"drive_x": (drive - drive.mean(), "V", 610.35), "sense_x": (sensed - sensed.mean(), "V", 610.35)}
    whole = _one_axis("silverbox", axis, **channels)
    return [whole], [whole], whole.device  # type: ignore[return-value]


def _pendulum(data: Path, *angles: int) -> Case:
    resonance = 2 * np.pi * 1.70
    axis = Axis(
        Mechanics(1.0, 0.5, resonance**2), readout=Position(1.0, np.deg2rad(1 / 11) / np.sqrt(12)),
        tolerance={"J": 1e-9, "gain": 1e-9, "k": 0.05, "b": 0.5}, name="x",
    )  # fmt: skip
    made = []
    for angle in angles:
        degrees = np.loadtxt(data / f"pendulum/swing_{angle}deg.txt", skiprows=2)
        released = degrees[{45: 150, 90: 250}[angle] :]
        made.append(_one_axis(f"pendulum-{angle}", axis, sense_x=(np.deg2rad(released), "V", 1000.0)))
    return made, made, made[0].device  # type: ignore[return-value]


def _membrane(data: Path, number: int, carrier: float = 2.0, rate: float = 25.0, most: float = 1e9) -> Case:
    (file,) = (data / "membranes").glob(f"measID_{number}_*.txt")
    time_s, power = np.loadtxt(file, comments="%", delimiter=",").T
    time_s, power = time_s[time_s < most], power[time_s < most]
    envelope = 10 ** (power / 20)
    envelope /= envelope[0]
    clock = np.arange(time_s[0], time_s[-1], 1 / rate)
    signal = np.interp(clock, time_s, envelope) * np.cos(2 * np.pi * carrier * clock)
    decay = -2 * np.log(envelope[-1] / envelope[envelope.size // 2]) / (time_s[-1] - time_s[envelope.size // 2])
    axis = Axis(
        Mechanics(1.0, decay, (2 * np.pi * carrier) ** 2), readout=Position(1.0, 2e-3),
        tolerance={"J": 1e-9, "gain": 1e-9, "k": 0.01, "b": 0.5}, name="x",
    )  # fmt: skip
    made = _one_axis(f"membrane-{number}", axis, sense_x=(signal, "V", rate))
    return [made], [made], made.device  # type: ignore[return-value]


def _tanks(data: Path) -> Case:
    drive, level = np.loadtxt(data / "tanks/estimation.csv", delimiter=",", skiprows=1, usecols=(0, 1)).T
    resonance = 2 * np.pi / 500.0
    axis = Axis(
        Mechanics(1.0 / resonance**2, 2.0 / resonance, 1.0), drive=Drive("linear", 2.0), readout=Position(1.0, 0.02),
        tolerance={"J": 0.5, "b": 0.5, "k": 1e-9, "torque_per_volt": 0.5, "gain": 1e-9}, name="x",
    )  # fmt: skip
    made = _one_axis("tanks", axis, drive_x=(drive, "V", 0.25), sense_x=(level, "V", 0.25))
    return [made], [made], made.device  # type: ignore[return-value]


def _beam(data: Path) -> Case:
    from recon.io.convert import convert

    mapping = Path(__file__).parents[1] / "examples/beam_decay.toml"
    whole = convert(next((data / "beam_decay").glob("*.lvm")), mapping)
    part = whole.slice(12.4, 16.4)
    return [part], [part], part.device  # type: ignore[return-value]


def _stage(data: Path) -> Case:
    sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
    from afm_model import recordings

    made = recordings(data / "afm_spiral/spiral_20hz.mat")["x"]
    return [made], [made], made.device  # type: ignore[return-value]


def _f16(data: Path) -> Case:
    from scipy.io import loadmat

    content = loadmat(data / "f16/full_multisine_level7.mat")
    force, acceleration = content["Force"][0], content["Acceleration"][0]
    resonance = 2 * np.pi * 7.3
    axis = Axis(
        Mechanics(1.0, resonance / 120, resonance**2), drive=Drive("linear", 4e-4), readout=Acceleration(1.0, 1e-3),
        tolerance={"J": 1e-9, "gain": 1e-9, "k": 0.05, "b": 0.5, "torque_per_volt": 0.5}, name="x",
    )  # fmt: skip
    made = _one_axis("f16", axis, drive_x=(force, "V", 400.0), sense_x=(acceleration, "V", 400.0))
    half = made.duration / 2
    return [made.slice(0, half)], [made.slice(half, made.duration)], made.device  # type: ignore[return-value]


ROWS: dict[str, Callable[[Path], Case]] = {
    "silverbox": _silverbox,
    "pendulum-45": lambda data: _pendulum(data, 45),
    "pendulum-90": lambda data: _pendulum(data, 90),
    "pendulum-both": lambda data: _pendulum(data, 45, 90),
    "membrane-3716": lambda data: _membrane(data, 3716),
    "membrane-505": lambda data: _membrane(data, 505),
    "tanks": _tanks,
    "beam": _beam,
    "stage": _stage,
    "f16": _f16,
}


def report(name: str, case: Case) -> dict[str, Any]:
    """What the diagnosis said of one row, and how the device predicts."""
    diagnosed, predicted, device = case
    began = time.perf_counter()
    found = diagnose(diagnosed, device, progress=lambda text: print(f"   ... {text}", file=sys.stderr, flush=True))
    seconds = time.perf_counter() - began
    errors = {}
    for each in predicted:
        before, after = (predict(each, one) for one in (device, found.device))
        for key in before:
            swing = float(np.nanstd(before[key].measured))
            errors[f"{each.name} {key}"] = [before[key].rmse, after[key].rmse, after[key].rmse / swing]
    content = found.to_json()
    findings = [
        {
            "effect": f["effect"], "stage": f["stage"], "p": round(f["probability"], 4), "share": f.get("share"),
            "parameters": {p["name"]: p["value"] for p in f["parameters"]},
            "rivals": {r["effect"]: round(r["probability"], 4) for r in f["rivals"][:4]},
        }
        for f in content["findings"]
    ]  # fmt: skip
    rest = {key: content.get(key) for key in ("verdict", "unexplained", "remainder", "open_loop")}
    return {"row": name, "seconds": round(seconds, 1), "findings": findings, **rest, "predict": errors}


def main(arguments: list[str]) -> None:
    """Diagnose the rows asked for."""
    data = Path(arguments[0])
    for name in arguments[1:] or ROWS:
        print(json.dumps(report(name, ROWS[name](data)), indent=1, ensure_ascii=False), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
