"""A short recording of two positions and an intensity, its changes, and the check of a command that refuses it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from recon.cli import main

RATE = 1e6
SAMPLES = 20_000
DEVICE = """
[x.readout]
kind = "position"
gain = 1.0
noise_sd = 1e-4
[y.readout]
kind = "position"
gain = 1.0
noise_sd = 1e-4
[scan]
half_angle_x = 0.11
half_angle_y = 0.11
"""
MECHANICS = """
[x.mechanics]
J = 1e-10
b = 1.2566e-8
k = 1.5791e-2
[x.drive]
kind = "linear"
torque_per_volt = 1e-6
[y.mechanics]
J = 1e-10
b = 5e-9
k = 2.5266e-3
[y.drive]
kind = "linear"
torque_per_volt = 1e-6
"""
Change = Callable[[h5py.File], None]


def signals() -> dict[str, np.ndarray]:
    """Positions [V] at 2000 and 800 Hz, an intensity and drives [V]."""
    time = np.arange(SAMPLES) / RATE
    x, y = 0.1 * np.sin(2 * np.pi * 2000 * time), 0.1 * np.sin(2 * np.pi * 800 * time)
    light = 100.0 + 50.0 * np.cos(30 * x) * np.cos(20 * y)
    return {
        "sense_x": x,
        "sense_y": y,
        "intensity": light,
        "drive_x": 5.0 * np.cos(2 * np.pi * 2000 * time),
        "drive_y": 5.0 * np.cos(2 * np.pi * 800 * time),
    }


def write(path: Path, device: str = DEVICE, change: Change | None = None, leave_out: tuple[str, ...] = ()) -> None:
    with h5py.File(path, "w") as file:
        file.attrs.update({"format": "lissajous-recording", "version": 1, "name": "wrong"})
        for name, values in signals().items():
            if name not in leave_out:
                dataset = file.create_dataset(f"channels/{name}", data=values)
                dataset.attrs.update({"unit": "V", "sample_rate": RATE, "start": 0.0})
        file.create_group("device").attrs["toml"] = device
        if change is not None:
            change(file)


DRIVES = ("drive_x", "drive_y")


def attribute(channel: str, key: str, value: object) -> Change:
    def change(file: h5py.File) -> None:
        if value is None:
            del file[f"channels/{channel}"].attrs[key]
        else:
            file[f"channels/{channel}"].attrs[key] = value

    return change


def values(channel: str, new: Callable[[np.ndarray], np.ndarray]) -> Change:
    def change(file: h5py.File) -> None:
        dataset = file[f"channels/{channel}"]
        attributes, data = dict(dataset.attrs), new(dataset[:])
        del file[f"channels/{channel}"]
        file.create_dataset(f"channels/{channel}", data=data).attrs.update(attributes)

    return change


FIELD = "[x]\n[y]\n[scan]\nhalf_angle_x = 0.11\nhalf_angle_y = 0.11\n"

SENSES = ("sense_x", "sense_y")


def edges(scale: float = 1.0, swapped: bool = False, frequency: float = 2000.0, **stated: float | str) -> Change:
    """Edges of both axes at each zero crossing upward, or at both crossings of a detector with an ``angle``."""

    def change(file: h5py.File) -> None:
        for name, f in (("x", frequency), ("y", 800.0)):
            period = 0.5 / f if "angle" in stated else 1.0 / f
            times = np.arange(0.0, SAMPLES / RATE, period) * scale
            dataset = file.create_dataset(f"channels/sync_{'xy'['yx'.index(name)] if swapped else name}", data=times)
            dataset.attrs.update({"unit": "s", **(stated or {"event": "zero-crossing-up"})})

    return change


def refused(arguments: list[str], folder: Path, words: str, capsys: pytest.CaptureFixture) -> str:
    """Check that a command ends with one line that holds ``words``, and writes nothing; return the line."""
    capsys.readouterr()
    assert main([*arguments, "-o", str(folder / "out")]) == 2
    captured = capsys.readouterr()
    lines = [line for line in captured.err.splitlines() if line.startswith("lissajous ")]
    assert len(lines) == 1, captured.err
    assert words in lines[0]
    assert "Traceback" not in captured.err
    assert not (folder / "out").exists()
    return lines[0]
