"""Every command that takes a recording also takes an instrument's file with a mapping."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from recon.cli import main
from scanner.errors import BadInput
from scanner.recording import Recording
from tests.support.simulated import separate_electrodes


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str]]:
    """A recording, and the arguments that name the same signals in a NumPy file."""
    folder = tmp_path_factory.mktemp("files")
    recording, _ = separate_electrodes()
    recording.write(folder / "run.h5")
    np.savez(folder / "run.npz", **{name: channel.read() for name, channel in recording.channels.items()})
    lines = [
        f'[channels.{name}]\nvariable = "{name}"\nunit = "V"\nsample_rate = 5e6\nstart = 0.0\n'
        for name in recording.channels
    ]
    assert recording.device_toml is not None
    device = re.sub(r"^\[", "[device.", recording.device_toml, flags=re.MULTILINE)
    (folder / "map.toml").write_text("".join(lines) + "[device]\n" + device, encoding="utf-8")
    return folder / "run.h5", [str(folder / "run.npz"), "--mapping", str(folder / "map.toml")]


def test_info_lists_the_channels_of_a_mapped_file(
    files: tuple[Path, list[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["info", *files[1], "--json"]) == 0
    description = json.loads(capsys.readouterr().out)
    assert description["format"] == "lissajous-recording"
    assert description["variables"]["sense_x"]["unit"] == "V"
    assert description["suggestion"] is None


@pytest.mark.slow
def test_predictions_of_a_recording_and_a_mapped_file_are_equal(
    files: tuple[Path, list[str]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording, mapped = files
    channels = []
    for arguments in ([str(recording)], mapped):
        assert main(["predict", *arguments, "-o", str(tmp_path / f"o{len(channels)}"), "--json"]) == 0
        channels.append(json.loads(capsys.readouterr().out)["channels"])
    assert channels[0] == channels[1]


@pytest.mark.parametrize(
    ("command", "function"),
    [
        ("diagnose", "estimation.complete_diagnosis.diagnose"),
        ("identify", "estimation.identification.calibrate.identify"),
    ],
)
def test_commands_of_many_recordings_take_a_mapping(
    command: str,
    function: str,
    files: tuple[Path, list[str]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def refuse_with_channel_names(recordings: list[Recording], *_: object) -> None:
        raise BadInput(", ".join(sorted(recordings[0].channels)))

    monkeypatch.setattr(function, refuse_with_channel_names)
    assert main([command, *files[1], "-o", str(tmp_path / "out")]) == 2
    assert "drive_x, drive_y, sense_x, sense_y" in capsys.readouterr().err
