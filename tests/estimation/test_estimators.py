"""The catalogue of estimators: every entry is complete, and a user's file adds one to every command."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import estimation.estimators as catalogue
from estimation.estimate import estimate
from estimation.estimators import estimators, register, registered
from recon.cli import main
from scanner import terms
from scanner.device import Axis, Device
from scanner.errors import BadInput
from scanner.recording import Recording
from scanner.stages import Drive, Mechanics, Position

DEVICE = "[x]\n[y]\n[scan]\nhalf_angle_x = 0.1\nhalf_angle_y = 0.1\n"
USER_ESTIMATOR = """
from estimation.estimators import Estimator, estimators
from scanner.motion import Motion


def run(recording, device):
    motion = estimators()["sensor"].run(recording, device)
    return Motion(motion.axes, "mine", {"by": "the user's file"})


MINE = Estimator("mine", "the sensor again", "angle channels", "never", run, "a test", is_model_based=False)
"""
USER_TERM = """
from scanner.terms import Parameter, Term


def output(signal, p, context):
    return signal + p[0]


TERM = Term(
    effect="shifted-field", stage="optics", equation="θ' = θ + d", source="a test", channels=("place",), output=output,
    parameters=(Parameter("d", "rad", lambda scales: 0.01),),
)
"""


@pytest.fixture(autouse=True)
def no_registered_files() -> Iterator[None]:
    yield
    catalogue._REGISTERED.clear()
    terms._REGISTERED.clear()


def scan() -> Recording:
    time = np.arange(20_000) / 1e6
    angles = {"x": 0.1 * np.sin(2 * np.pi * 9000.0 * time), "y": 0.1 * np.sin(2 * np.pi * 2130.0 * time)}
    channels = {f"angle_{axis}": (angle, "rad", 1e6, 0.0) for axis, angle in angles.items()}
    light = (np.cos(30 * angles["x"]) + 2.0, "V", 1e6, 0.0)
    return Recording.from_arrays({**channels, "intensity": light}, Device.from_toml(DEVICE), "scan")


def test_every_estimator_states_summary_needs_use_and_source() -> None:
    assert set(estimators()) >= {"constant", "acm", "ekf", "ukf", "hyb", "sine-ukf", "tracker", "picture", "sensor"}
    for name, estimator in estimators().items():
        assert estimator.name == name
        assert all((estimator.summary, estimator.needs, estimator.use_when, estimator.source))


def test_a_file_adds_an_estimator(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "mine.py"
    path.write_text(USER_ESTIMATOR)
    register(path)
    assert registered() == (path.resolve(),)
    assert estimate(scan(), None, "mine").info == {"by": "the user's file"}
    catalogue._REGISTERED.clear()
    scan().write(tmp_path / "scan.h5")
    arguments = ["reconstruct", str(tmp_path / "scan.h5"), "-o", str(tmp_path / "out"), "--pixels", "40x40", "--json"]
    assert main([*arguments, "--estimator", "mine"]) == 2
    assert "no estimator is named 'mine'" in capsys.readouterr().err
    assert main([*arguments, "--estimator", "mine", "--estimators", str(path)]) == 0
    assert json.loads(capsys.readouterr().out)["estimator"] == "mine"


def test_one_file_may_add_an_estimator_and_an_effect_of_the_optics(tmp_path: Path) -> None:
    from estimation.optics.correction import beam_motion

    path = tmp_path / "both.py"
    path.write_text(USER_ESTIMATOR + USER_TERM)
    register(path)
    terms.register(path)
    device = Device.from_toml(DEVICE + "[x.terms.shifted-field]\nd = 0.02\n")
    motion = estimate(scan(), device, "mine")
    beam = beam_motion(motion, device, 0.0)
    np.testing.assert_allclose(beam.axes["x"].angle.read(), motion.axes["x"].angle.read() + 0.02)


def test_a_file_without_an_estimator_is_refused(tmp_path: Path) -> None:
    (tmp_path / "nothing.py").write_text("x = 1\n")
    with pytest.raises(BadInput, match="holds no estimator"):
        register(tmp_path / "nothing.py")


def test_the_catalogue_loads_no_library_that_the_estimators_compute_with() -> None:
    code = (
        "import sys; from estimation.estimators import estimators; estimators(); "
        "assert not {'scipy.signal', 'filterpy', 'estimation.filters.run', 'estimation.tracker'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[2])


def slow_scan(waveform: str, driven: bool) -> tuple[Recording, dict[str, np.ndarray]]:
    """A stage of 800 Hz resonance that is moved far below it, and its angles [rad]."""
    time = np.arange(40_000) / 20e3
    radius, turn = 0.05 * time / time[-1], 2 * np.pi * 20.0 * time
    angles = {"x": radius * np.cos(turn), "y": radius * np.sin(turn)}
    if waveform == "raster":
        angles = {"x": 0.05 * (2.0 * np.abs(2.0 * (20.0 * time % 1.0) - 1.0) - 1.0), "y": 0.05 * (time - 1.0)}
    rng = np.random.default_rng(3)
    mechanics = Mechanics(1e-9, 1e-9 * 2 * np.pi * 800.0 / 20.0, 1e-9 * (2 * np.pi * 800.0) ** 2)
    axis = Axis(mechanics, drive=Drive("linear", 1e-6), readout=Position(10.0, 1e-3, 0.1))
    channels = {}
    for name, angle in angles.items():
        channels[f"sense_{name}"] = (10.0 * angle + 0.1 + rng.normal(0.0, 1e-3, time.size), "V", 20e3, 0.0)
        if driven:
            channels[f"drive_{name}"] = (100.0 * angle, "V", 20e3, 0.0)
    device = Device("stage", {name: replace(axis, name=name) for name in angles})
    return Recording.from_arrays(channels, device), angles


@pytest.mark.parametrize("driven", [True, False])
@pytest.mark.parametrize("waveform", ["spiral", "raster"])
def test_sensor_takes_position_samples_as_they_are_whatever_the_waveform(waveform: str, driven: bool) -> None:
    recording, angles = slow_scan(waveform, driven)
    motion = estimate(recording, method="sensor")
    for name, angle in angles.items():
        assert np.abs(motion.axes[name].angle.read() - angle).max() < 6e-4  # six times the noise
        assert motion.axes[name].sign == f"known: sense_{name}"
