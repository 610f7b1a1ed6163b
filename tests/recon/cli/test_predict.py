"""What a prediction states of the device."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from phantoms.forward import Plan, simulate
from phantoms.waveforms import Sine
from recon.cli import main
from scanner.device import Device
from scanner.device_templates import KnownAxis, new_device
from tests.support.simulated import imaging


def test_a_prediction_states_the_drifts_of_the_device(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """A drift starts again in each recording, also in one that was made later."""
    device = Device.from_toml(new_device("electromagnetic", {"x": KnownAxis(2000.0), "y": KnownAxis(835.0)}))
    plan = Plan({"x": Sine(2000.0, 10.0), "y": Sine(835.0, 10.0)}, 0.01, 2e5)
    simulate(device, plan)[0].write(tmp_path / "r.h5")
    terms = {"cubic-stiffness": {"k3": 0.01}, "gain-drift": {"g": 0.1, "T": 0.01}}
    drifting = replace(device, axes=dict(device.axes) | {"x": replace(device.axis("x"), terms=terms)})
    (tmp_path / "device.toml").write_text(drifting.to_toml())
    command = ["predict", str(tmp_path / "r.h5"), "--device", str(tmp_path / "device.toml"), "-o", str(tmp_path / "o")]
    assert main(command) == 0
    assert "axis x drifts from the first sample on" in capsys.readouterr().out
    assert json.loads((tmp_path / "o" / "summary.json").read_text())["drifts"] == {"x": ["gain-drift"]}


def test_a_steady_motion_without_its_drive_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    recording, _ = imaging()
    channels = {name: channel for name, channel in recording.channels.items() if not name.startswith("drive")}
    replace(recording, channels=channels).write(tmp_path / "r.h5")
    assert main(["predict", str(tmp_path / "r.h5"), "-o", str(tmp_path / "o")]) == 2
    assert "sense moves steadily without drive_x and drive_y; record the voltage" in capsys.readouterr().err
    assert not (tmp_path / "o").exists()


def test_an_axis_without_its_drive_is_named(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    recording, _ = imaging()
    channels = {name: channel for name, channel in recording.channels.items() if name != "drive_y"}
    replace(recording, channels=channels).write(tmp_path / "r.h5")
    assert main(["predict", str(tmp_path / "r.h5"), "-o", str(tmp_path / "o")]) == 0
    assert "axis y: drive_y is not in the recording; a free decay is predicted" in capsys.readouterr().out
    assert json.loads((tmp_path / "o" / "summary.json").read_text())["undriven"] == ["y"]
