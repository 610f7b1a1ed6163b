"""Commands take a device by its name or as a file."""

from pathlib import Path

import pytest

from recon.cli import main
from recon.steps.preparation import select_device
from scanner import devices
from scanner.errors import BadInput
from tests.support.simulated import imaging


def test_a_device_is_found_by_name_by_file_and_as_it_is(tmp_path: Path) -> None:
    device = devices.load("imaging")
    (tmp_path / "own.toml").write_text(device.to_toml(), encoding="utf-8")
    assert devices.find("imaging") == devices.find(tmp_path / "own.toml") == devices.find(device)
    assert select_device(imaging()[0], "chen2020").name == "chen2020"


@pytest.mark.parametrize("command", ["reconstruct", "predict", "identify", "diagnose"])
def test_a_device_that_is_neither_is_refused(command: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    imaging()[0].slice(0.0, 0.001).write(tmp_path / "scan.h5")
    arguments = [command, str(tmp_path / "scan.h5"), "-o", str(tmp_path / "out"), "--device", "imagin"]
    assert main(arguments) == 2
    line = capsys.readouterr().err.strip().splitlines()[-1]
    assert "no device is named 'imagin' and no file is" in line
    assert "imaging" in line
    assert not (tmp_path / "out").exists()


def test_simulate_drives_a_device_of_ones_own_so_that_it_fills_the_field(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    device, scan = str(tmp_path / "own.toml"), str(tmp_path / "scan.h5")
    assert main(["new-device", "--kind", "electromagnetic", "-o", device]) == 0
    simulate = ["simulate", "--device", device, "-o", scan, "--duration", "0.005", "--rate", "2e5"]
    assert main([*simulate, "--drive-y", "800,3,0"]) == 0
    assert "driven at x 2000 Hz, 10 V, offset 0 V, y 800 Hz, 3 V, offset 0 V" in capsys.readouterr().out


def test_the_text_of_a_device_is_no_name() -> None:
    with pytest.raises(BadInput, match="device: is the text of a device, neither a name nor the path of a file") as bad:
        devices.find('[x.readout]\nkind = "position"\n')
    assert str(bad.value).count("readout") == 0
