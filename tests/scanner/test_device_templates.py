"""New device files: readable by the program, filled with what is known, typical elsewhere."""

import json
import re
import shlex
from pathlib import Path

import pytest

from recon.cli import main
from recon.cli import new_device as new_device_command
from scanner.device import Device
from scanner.device_templates import KINDS, KnownAxis, new_device
from scanner.errors import BadInput, DeviceInvalid


def test_the_command_offers_every_kind() -> None:
    assert tuple(KINDS) == new_device_command.KINDS


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_is_a_valid_device_with_a_comment_on_every_value(kind: str) -> None:
    text = new_device(kind, {})
    device = Device.from_toml(text)
    assert set(device.axes) == {"x", "y"}
    assert device.extra == {}
    assert all(axis.extra == {} and axis.mechanics and axis.drive for axis in device.axes.values())
    assert device.scan is not None
    assert device.readout or all(axis.readout for axis in device.axes.values())
    assert device.axes["x"].resonance == pytest.approx(KINDS[kind].x.resonance, rel=1e-4)
    assert device.axes["y"].quality == pytest.approx(KINDS[kind].y.quality, rel=1e-4)
    assert "typical" in text


@pytest.mark.parametrize("kind", KINDS)
def test_known_values_replace_typical_ones(kind: str) -> None:
    known = {"x": KnownAxis(5000.0, 321.0, 0.05, 10040.0), "y": KnownAxis(amplitude=0.07)}
    device = Device.from_toml(new_device(kind, known, 'my "own"'))
    axis = device.axes["x"]
    assert axis.resonance == pytest.approx(5000.0, rel=1e-4)
    assert axis.quality == pytest.approx(321.0, rel=1e-4)
    assert axis.drive is not None
    assert axis.drive.frequency == 10040.0
    assert axis.tolerance["k"] < device.axes["y"].tolerance["k"]
    assert device.require_scan().mechanical_half_angles == (0.05, 0.07)
    assert device.name == 'my "own"'


def test_a_resonance_follows_from_the_drive_frequency() -> None:
    known = {"x": KnownAxis(drive_frequency=2000.0)}
    linear, parametric = (Device.from_toml(new_device(kind, known)) for kind in ("electromagnetic", "parametric"))
    assert linear.axes["x"].resonance == pytest.approx(2000.0, rel=1e-4)
    assert parametric.axes["x"].resonance == pytest.approx(1000.0, rel=0.01)


@pytest.mark.parametrize(
    ("kind", "known", "source"),
    [
        ("electromagnetic", KnownAxis(drive_frequency=2000.0), "2000 Hz, from the stated drive frequency"),
        ("electromagnetic", KnownAxis(2010.0, drive_frequency=2000.0), "2010 Hz, as stated"),
        ("afm", KnownAxis(drive_frequency=1.0), "Hz, typical"),  # driven far below its resonance
    ],
)
def test_a_comment_says_where_the_resonance_is_from(kind: str, known: KnownAxis, source: str) -> None:
    text = new_device(kind, {"x": known})
    (line, _) = (line for line in text.splitlines() if "for a resonance of" in line)
    assert line.endswith(source)
    assert Device.from_toml(text).axes["x"].tolerance["k"] == (0.02 if "typical" in source else 0.002)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "afm"])
def test_a_resonance_in_kilohertz_is_refused(kind: str) -> None:
    for resonance in (0.7, 5.4, 49.0):
        with pytest.raises(BadInput, match=f"--resonance-y: is {resonance:g} Hz, .* {1e3 * resonance:g} Hz"):
            new_device(kind, {"y": KnownAxis(resonance)})
    for resonance in (60.0, 700.0, 5400.0, 49e3):
        assert Device.from_toml(new_device(kind, {"y": KnownAxis(resonance)})).axes["y"].resonance > 59.0


def test_a_device_may_state_drive_frequencies_only() -> None:
    known = {"x": KnownAxis(drive_frequency=2000.0, amplitude=0.1), "y": KnownAxis(drive_frequency=900.0)}
    device = Device.from_toml(new_device("electromagnetic", known, frequencies_only=True))
    assert all(axis.mechanics is None and axis.readout is None for axis in device.axes.values())
    assert device.axes["y"].require_drive().frequency == 900.0
    with pytest.raises(BadInput, match="drive-frequency-y: is not stated"):
        new_device("parametric", {"x": known["x"]}, frequencies_only=True)
    with pytest.raises(DeviceInvalid, match="torque_per_volt: is missing"):
        Device.from_toml('[x.mechanics]\nJ = 1\nb = 1\nk = 1\n[x.drive]\nkind = "linear"\nfrequency = 5.0')


def test_the_command_writes_the_file_once(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    path = tmp_path / "device.toml"
    arguments = ["new-device", "-o", str(path), "--kind", "piezo", "--resonance-x", "21e3", "--json"]
    assert main(arguments) == 0
    assert json.loads(capsys.readouterr().out)["resonance_hz"]["x"] == pytest.approx(21e3, rel=1e-4)
    before = path.read_text(encoding="utf-8")
    assert main(arguments) == 2
    assert "exists already" in capsys.readouterr().err
    assert path.read_text(encoding="utf-8") == before


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["parametric", "electromagnetic"])
def test_the_command_in_the_heading_and_a_reconstruction_run(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "device.toml"
    path.write_text(new_device(kind, {}), encoding="utf-8")
    heading = path.read_text(encoding="utf-8").partition("\n\n")[0]
    found = re.search(r"lissajous (simulate .*?)-o", heading.replace("\\\n#", " "))
    assert found is not None
    words = shlex.split(found[1].replace("device.toml", str(path)))
    words[words.index("--duration") + 1] = "0.03"
    assert main([*words, "-o", str(tmp_path / "scan.h5")]) == 0
    out = tmp_path / "out"
    reconstruct = ["reconstruct", str(tmp_path / "scan.h5"), "--device", str(path), "--pixels", "60x60"]
    assert main([*reconstruct, "-o", str(out), "--estimator", "tracker" if kind == "parametric" else "sensor"]) == 0
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert summary["x"]["phase_rmse_deg"] < 0.5
