"""Recordings that are shorter than a period of the slower axis are refused in one line."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.short_recordings import LINEAR_HZ, PARAMETRIC_HZ, linear_device
from phantoms.experiment import Experiment, simulate_experiment
from phantoms.forward import Plan, simulate
from phantoms.waveforms import Sine
from recon.cli import main
from recon.quality.duration_check import check_duration
from scanner.device import Device
from scanner.errors import BadInput
from scanner.recording import Recording
from scanner.stages import Drive

RATE_HZ = 1e6
FIELD = "\n[scan]\nhalf_angle_x = 0.2\nhalf_angle_y = 0.2\n"


def combs() -> Recording:
    """Drives, one sense signal of both axes and the intensity."""
    return simulate_experiment(Experiment(duration=2 / PARAMETRIC_HZ["y"]), 11)[0]


def positions(*without: str) -> Recording:
    """Linear drives, position readouts and an intensity."""
    drives = {name: Sine(frequency, 10.0) for name, frequency in LINEAR_HZ.items()}
    recording, _ = simulate(linear_device(), Plan(drives, 2 / LINEAR_HZ["y"]), seed=12)
    light = np.random.default_rng(13).poisson(50.0, round(2 / LINEAR_HZ["y"] * RATE_HZ)) / 50.0
    channels = {
        k: (c.read(), c.unit, c.sample_rate, c.start) for k, c in recording.channels.items() if k not in without
    }
    device = Device.from_toml(linear_device().to_toml() + FIELD)
    return Recording.from_arrays({**channels, "intensity": (light, "V", RATE_HZ, 0.0)}, device)


def shortened(recording: Recording, seconds: float) -> Recording:
    channels = {
        name: (channel.read(0, round(seconds * channel.sample_rate)), channel.unit, channel.sample_rate, channel.start)
        for name, channel in recording.channels.items()
    }
    return Recording.from_arrays(channels, recording.device)


@pytest.mark.parametrize("periods", [0.3, 0.7, 0.95])
@pytest.mark.parametrize("case", ["combs", "positions", "positions without drives", "drives alone"])
def test_less_than_a_period_is_refused(
    case: str, periods: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording, channel = {
        "combs": (combs, "sense"),
        "positions": (positions, "sense_y"),
        "positions without drives": (lambda: positions("drive_x", "drive_y"), "sense_y"),
        "drives alone": (lambda: positions("sense_x", "sense_y"), "drive_y"),
    }[case]
    whole = recording()
    assert whole.device is not None
    path = tmp_path / "scan.h5"
    shortened(whole, periods / whole.device.axis("y").resonance).write(path)
    assert main(["reconstruct", str(path), "-o", str(tmp_path / "out")]) == 2
    (line,) = (each for each in capsys.readouterr().err.splitlines() if each.startswith("lissajous"))
    said = re.search(rf"scan\.h5: {channel}: holds (\S+) periods of the motion of y at ", line)
    assert said is not None, line
    assert float(said[1]) == pytest.approx(periods, abs=1e-3)
    assert "; record for longer, or check sample_rate, and J and k in [y.mechanics] of the device" in line
    assert not (tmp_path / "out").exists()


def test_more_than_one_and_a_half_periods_of_positions_are_reconstructed(tmp_path: Path) -> None:
    shortened(positions(), 1.6 / LINEAR_HZ["y"]).write(tmp_path / "scan.h5")
    assert main(["reconstruct", str(tmp_path / "scan.h5"), "-o", str(tmp_path / "out"), "--pixels", "64x64"]) == 0


def test_a_linear_drive_above_the_resonance_has_periods_of_its_own() -> None:
    time = np.arange(round(0.7 / LINEAR_HZ["y"] * RATE_HZ)) / RATE_HZ
    channels = {k: (c.read(0, time.size), c.unit, RATE_HZ) for k, c in positions().channels.items()}
    with pytest.raises(BadInput, match=r"sense_y: holds 0\.6993 periods"):
        check_duration(Recording.from_arrays(channels), positions().device)
    channels["drive_y"] = (np.sin(2 * np.pi * 3.0 * LINEAR_HZ["y"] * time), "V", RATE_HZ)
    check_duration(Recording.from_arrays(channels), positions().device)


def test_a_frequency_that_the_device_states_counts_without_a_recorded_drive() -> None:
    whole = positions("drive_x", "drive_y")
    device = whole.device
    assert device is not None
    slow = replace(device.axis("y"), mechanics=None, drive=Drive("electrostatic", frequency=500.0))
    device = replace(device, axes={**device.axes, "y": slow})
    with pytest.raises(
        BadInput, match=r"sense_y: holds 0\.23\d+ periods of the motion of y at 250 Hz.*frequency in \[y\.drive\]"
    ):
        check_duration(whole, device)


def test_a_ramp_without_mechanics_is_one_frame() -> None:
    time = np.arange(2000) / RATE_HZ
    readouts = "".join(f'[{a}.readout]\nkind = "position"\ngain = 10.0\nnoise_sd = 0.01\n' for a in "xy")
    device = Device.from_toml(readouts + FIELD)
    ramp = {"sense_x": (np.sin(2e4 * np.pi * time), "V", RATE_HZ), "sense_y": (500.0 * time - 0.5, "V", RATE_HZ)}
    check_duration(Recording.from_arrays(ramp), device)
