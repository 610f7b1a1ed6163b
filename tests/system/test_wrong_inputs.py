"""Wrong inputs as users make them: each ends in one line with the cause, or in a picture with a stated warning."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from io import BytesIO, TextIOWrapper
from pathlib import Path

import h5py
import numpy as np
import pytest

import lissajous
from recon.cli import main
from recon.evaluation import truth_from_simulation
from scanner.device import Device
from scanner.errors import BadInput
from tests.support.wrong_inputs import (
    DEVICE,
    DRIVES,
    FIELD,
    MECHANICS,
    RATE,
    SAMPLES,
    SENSES,
    Change,
    attribute,
    edges,
    refused,
    signals,
    values,
    write,
)


def without(channel: str) -> Change:
    def change(file: h5py.File) -> None:
        del file[f"channels/{channel}"]

    return change


def field(x: float, y: float) -> str:
    return DEVICE.replace("half_angle_x = 0.11", f"half_angle_x = {x}").replace(
        "half_angle_y = 0.11", f"half_angle_y = {y}"
    )


DRIVEN = '[x.drive]\nkind = "linear"\nfrequency = {}\n[y.drive]\nkind = "linear"\nfrequency = {}\n' + FIELD[8:]
RESONANT = "[x.mechanics]\nJ = 1e-10\nb = 1.2566e-8\nk = 1.5791e-2\n"


def both_crossings(place: float = 0.0) -> Change:
    """Edges of x in both directions, by a detector at ``place`` of the swing, stated as upward ones."""

    def change(file: h5py.File) -> None:
        late = np.arcsin(place) / np.pi
        half_periods = np.arange(2.0 * 2000.0 * SAMPLES / RATE)
        times = (half_periods + late * (-1.0) ** half_periods) / 4000.0
        dataset = file.create_dataset("channels/sync_x", data=times[times >= 0.0])
        dataset.attrs.update({"unit": "s", "event": "zero-crossing-up"})
        angle = file.create_dataset("channels/angle_y", data=signals()["sense_y"])
        angle.attrs.update({"unit": "rad", "sample_rate": RATE})

    return change


def z_in_micrometres(file: h5py.File) -> None:
    z = file.create_dataset("channels/position_z", data=np.repeat([10.0, 12.0, 14.0], 100))
    z.attrs.update({"unit": "m", "sample_rate": 15e3})


def left_out(device: str) -> tuple[str, ...]:
    """Channels that a recording with this device lacks: sensors need a readout."""
    return DRIVES if "readout" in device else (*DRIVES, *SENSES)


def swapped_drives(file: h5py.File) -> None:
    x, y = (file[f"channels/drive_{axis}"][:] for axis in "xy")
    file["channels/drive_x"][:], file["channels/drive_y"][:] = y, x


REFUSED_RECORDINGS: dict[str, tuple[str, Change | None, str]] = {
    "field in degrees": (field(6.3, 6.3), None, "looks like degrees"),
    "field in mrad": (field(110.0, 110.0), None, "looks like mrad"),
    "field far too small": (field(0.005, 0.005), None, "lie outside the field of view (x up to 0.1"),
    "negative field": (field(-0.1, 0.1), None, "scan.half_angle_x: is -0.1 and must be a number greater than 0"),
    "unknown kind of angle": (DEVICE + 'angle = "beam"', None, "scan.angle: 'beam' is unknown"),
    "gain of zero": (DEVICE.replace("gain = 1.0", "gain = 0.0", 1), None, "x.readout.gain: is 0.0"),
    "gain as text": (DEVICE.replace("gain = 1.0", 'gain = "1 V/rad"', 1), None, "must be a number"),
    "readout missing": (DEVICE.replace("[y.readout]", "[y.sensor]"), None, "sense_y is no position readout"),
    "one axis": (DEVICE.partition("[y.readout]")[0], None, "y: is missing and needed here"),
    "device is no TOML": ("[x.readout", None, "is not TOML"),
    "no intensity": (DEVICE, without("intensity"), "intensity: is not in the recording"),
    "intensity all NaN": (DEVICE, values("intensity", lambda v: v * np.nan), "holds no sample that can be used"),
    "intensity constant": (DEVICE, values("intensity", lambda v: 0 * v), "intensity: is constant, 0 V"),
    "intensity empty": (DEVICE, values("intensity", lambda v: v[:0]), "holds no samples"),
    "intensity of three dimensions": (DEVICE, values("intensity", lambda v: v.reshape(-1, 10, 10)), "has shape"),
    "intensity complex": (DEVICE, values("intensity", lambda v: v + 0j), "not real numbers"),
    "no sense of y": (DEVICE, without("sense_y"), "y"),
    "sense constant": (DEVICE, values("sense_x", lambda v: 0 * v + 1), "sense_x: is constant, 1 V"),
    "sense infinite": (DEVICE, values("sense_x", lambda v: v + np.inf), "sense_x: holds no sample that can be used"),
    "rate negative": (DEVICE, attribute("sense_x", "sample_rate", -1e6), "sense_x: sample_rate is -1e+06 Hz"),
    "rate zero": (DEVICE, attribute("intensity", "sample_rate", 0.0), "intensity: sample_rate is 0 Hz"),
    "rate missing": (DEVICE, attribute("sense_y", "sample_rate", None), "sense_y: sample_rate is missing"),
    "rate as text": (DEVICE, attribute("sense_y", "sample_rate", "1 MHz"), "sense_y: sample_rate is '1 MHz'"),
    "unit missing": (DEVICE, attribute("sense_x", "unit", None), "sense_x: unit is missing"),
    "unit unknown": (DEVICE, attribute("sense_x", "unit", "Volts DC"), "sense_x: unit 'Volts DC' is unknown"),
    "channels that do not overlap": (DEVICE, attribute("intensity", "start", 5.0), "intensity"),
    "edges in ms stated as s": (FIELD, edges(1e3), "of its 40 edges lie between 0 s and 0.02 s"),
    "edges swapped": (DRIVEN.format(2000.0, 800.0), edges(swapped=True), "they fit y: sync_x and sync_y are swapped"),
    "every second edge missing": (DRIVEN.format(2000.0, 800.0), edges(frequency=1000.0), "the drive moves x at 2000"),
    "both crossings as upward, driven": (DRIVEN.format(2000.0, 800.0), both_crossings(), "twice as many edges"),
    "both crossings as upward, resonant": (
        FIELD + RESONANT, both_crossings(), "the resonance of x in the device file is 1999.98 Hz; state event as"),
    "both crossings as upward, beside the centre": (FIELD, both_crossings(0.02), "its intervals alternate between"),
    "both crossings as upward, far from the centre": (FIELD, both_crossings(0.7), "its intervals alternate between"),
    "edges of an unknown event": (FIELD, edges(event="rising"), "sync_x: event 'rising' is unknown"),
    "drive frequency in kHz": (DRIVEN.format(2.0, 0.8), None, "0.04 periods of a motion at 2 Hz in x; check frequency"),
    "intensity transposed": (DEVICE, values("intensity", lambda v: np.stack([v, v])), "2 samples of 20000 detectors"),
    "counts of a converter as V": (DEVICE, values("sense_x", lambda v: (1e5 * v).astype(np.int16)), "no mirror turns"),
    "a sensor used twice": (DEVICE, lambda file: file["channels/sense_y"].write_direct(
        file["channels/sense_x"][:]), "hold the same samples"),
    "newer format": (DEVICE, lambda file: file.attrs.update({"version": 99}), "version"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED_RECORDINGS)
def test_a_wrong_recording_or_device_is_refused_in_one_line(
    case: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    device, change, words = REFUSED_RECORDINGS[case]
    write(tmp_path / "scan.h5", device, change, left_out(device))
    line = refused(["reconstruct", str(tmp_path / "scan.h5"), "--pixels", "40x40"], tmp_path, words, capsys)
    assert f"{tmp_path / 'scan.h5'}: " in line


@pytest.mark.parametrize(
    ("drive", "words"),
    [
        ("swapped", "drive_x: and drive_y are swapped: they move x at 800"),
        ("rate ten times too large", "as if the sample rate were 10 times the true one"),
        ("rate in kHz", "as if the sample rate were 0.001 times the true one"),
    ],
)
def test_wrong_drives_are_refused_in_one_line(
    drive: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    def change(file: h5py.File) -> None:
        if drive == "swapped":
            swapped_drives(file)
        else:
            for channel in file["channels"].values():
                channel.attrs["sample_rate"] = RATE * (10.0 if "ten" in drive else 1e-3)

    write(tmp_path / "scan.h5", DEVICE + MECHANICS, change)
    refused(
        ["reconstruct", str(tmp_path / "scan.h5"), "--pixels", "40x40", "--estimator", "tracker"],
        tmp_path,
        words,
        capsys,
    )


WARNED: dict[str, tuple[str, Change | None, str]] = {
    "field a little small": (field(0.09, 0.11), None, "of the samples lie outside the field of view"),
    "field far too large": (field(0.9, 0.9), None, "the motion covers little of the field of view"),
    "no field": (DEVICE.partition("[scan]")[0], None, "the field is the motion's own"),
    "misspelt key": (DEVICE.replace("noise_sd = 1e-4", "noise_sd = 1e-4\noffest = 1.0", 1), None, "x.readout.offest"),
    "misspelt channel": (DEVICE, lambda file: file.copy("channels/sense_x", "channels/sense_z"), "sense_z"),
    "detector's angle in degrees": (FIELD, edges(angle=1.1), "a detector at 1.1 rad, and its edges are evenly spaced"),
    "half of a sensor's swing": (DEVICE, values("sense_x", lambda v: np.maximum(v, 0.0)), "x is centred at +0.05 rad"),
    "millivolts stated as volts": (DEVICE.replace("gain = 1.0", "gain = 1000.0"), None, "covers little of the field"),
}  # fmt: skip


@pytest.mark.parametrize("case", WARNED)
def test_a_doubtful_input_makes_a_picture_with_a_warning(
    case: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    device, change, words = WARNED[case]
    write(tmp_path / "scan.h5", device, change, left_out(device))
    arguments = [str(tmp_path / "scan.h5"), "--pixels", "40x40", "-o", str(tmp_path / "out"), "--json"]
    assert main(["reconstruct", *arguments]) == 0
    notes = json.loads(capsys.readouterr().out)["notes"]
    assert any(words in note for note in notes), notes


FILES: dict[str, tuple[str, bytes, str]] = {
    "empty recording": ("scan.h5", b"", "scan.h5"),
    "text named h5": ("scan.h5", b"Time,CH1\n0,1\n", "scan.h5"),
    "beginning of a recording": ("scan.h5", b"\x89HDF\r\n\x1a\n" + bytes(40), "scan.h5"),
}


@pytest.mark.parametrize("case", FILES)
def test_a_damaged_file_is_refused_in_one_line(case: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    name, content, words = FILES[case]
    (tmp_path / name).write_bytes(content)
    refused(["reconstruct", str(tmp_path / name)], tmp_path, words, capsys)


def csv(times: list[float], head: str = "Time (s),CH1 (V),CH2 (V)") -> str:
    return head + "\n" + "".join(f"{t:.9g},{k},{2 * k}\n" for k, t in enumerate(times))


EVEN = [k * 1e-6 for k in range(30)]
TABLES: dict[str, tuple[str, list[str], str]] = {
    "missing column": (csv(EVEN), ["sense_x=CH7"], "there is no variable 'CH7'; scope.csv holds Time (30,), CH1 (30,)"),
    "uneven times": (csv([t + 3e-6 * (t > 1e-5) for t in EVEN]), ["sense_x=CH1"], "times are not uniform: sample"),
    "falling times": (csv(EVEN[::-1]), ["sense_x=CH1"], "its times do not rise"),
    "equal times": (csv([0.0] * 30), ["sense_x=CH1"], "its times do not rise"),
    "no times": (csv(EVEN, "A,CH1,CH2"), ["sense_x=CH1"], "no sample_rate"),
    "current as voltage": (csv(EVEN, "Time (s),CH1 (A),CH2 (V)"), ["sense_x=CH1"], "unit 'A' is unknown"),
    "names only": ("Time (s),CH1 (V)\n", ["sense_x=CH1"], "holds no table of numbers"),
    "a word in the table": (csv(EVEN).replace("\n5e-06,5,", "\n5e-06,five,"), ["sense_x=CH1"], "line 7: 'five' is no"),
    "a short line": (csv(EVEN).replace("\n5e-06,5,10\n", "\n5e-06,5\n"), ["sense_x=CH1"], "line 7 ends after 2 of 3"),
    "one channel twice": (csv(EVEN), ["sense_x=CH1", "sense_x=CH2"], "repeats a channel"),
    "detectors of two units": (csv(EVEN, "Time (s),CH1 (V),CH2 (mV)"), ["intensity=CH1,CH2"], "differ in unit"),
}  # fmt: skip


@pytest.mark.parametrize("case", TABLES)
def test_a_wrong_table_is_refused_in_one_line(case: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    text, channels, words = TABLES[case]
    (tmp_path / "scope.csv").write_text(text, encoding="utf-8")
    options = [word for channel in channels for word in ("--channel", channel)]
    refused(["convert", str(tmp_path / "scope.csv"), *options], tmp_path, words, capsys)


def test_there_are_forty_wrong_inputs() -> None:
    assert len(REFUSED_RECORDINGS) + len(WARNED) + len(FILES) + len(TABLES) >= 40


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"scene": "hello"}, "/truth/scene: is not a matrix of numbers; store it as `lissajous simulate` does"),
        ({"scene": np.ones(9)}, "/truth/scene: is not a matrix"),
        ({"angle_x": (np.ones(9), {"sample_rate": "fast"})}, "/truth/angle_x, sample_rate: is not a number"),
        ({"angle_x": (np.ones(9), {"sample_rate": 0.0})}, "/truth/angle_x: states a sample_rate of 0 Hz"),
        ({"spot_sd": [1.0, 2.0]}, "/truth/spot_sd: is not a number"),
    ],
)
def test_a_truth_that_is_none_is_refused(changes: dict, words: str) -> None:
    with pytest.raises(BadInput, match=words):
        truth_from_simulation({"angle_x": (np.ones(9), {"sample_rate": 1e3})} | changes)


def test_a_truth_of_another_time_is_refused() -> None:
    angle = (np.ones(SAMPLES), {"sample_rate": RATE, "start": 5.0})
    with pytest.raises(BadInput, match="/truth: has no angle at the time of the motion; correct the channels' start"):
        lissajous.reconstruct(arrays(), Device.from_toml(DEVICE), pixels=(20, 20), truth={"angle_x": angle})


def test_a_position_in_another_unit_is_noted(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    write(tmp_path / "scan.h5", DEVICE, z_in_micrometres, DRIVES)
    arguments = ["--pixels", "40x40", "--frames", "-o", str(tmp_path / "out"), "--json"]
    assert main(["reconstruct", str(tmp_path / "scan.h5"), *arguments]) == 0
    notes = json.loads(capsys.readouterr().out)["notes"]
    assert any("position_z: moves by 4 m; no objective does: check its unit" in note for note in notes), notes


def test_a_range_in_millimetres_stated_in_metres_is_noted(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    def change(file: h5py.File) -> None:
        shots = file.create_dataset("channels/range", data=np.full(SAMPLES, 8000.0))
        shots.attrs.update({"unit": "m", "sample_rate": RATE})

    write(tmp_path / "scan.h5", DEVICE, change, DRIVES)
    assert main(["point-cloud", str(tmp_path / "scan.h5"), "-o", str(tmp_path / "out")]) == 0
    assert "range: reaches 8000 m; if these are millimetres, state the unit mm" in capsys.readouterr().out


def arrays() -> dict[str, tuple]:
    names = ("sense_x", "sense_y", "intensity")
    return {name: (values, "V", RATE) for name, values in signals().items() if name in names}


@pytest.mark.parametrize("bare", [False, True])
def test_masked_samples_are_missing_samples(bare: bool) -> None:
    light = signals()["intensity"]
    masked = {**arrays(), "intensity": (np.ma.masked_less(light, 100.0), "V", RATE)}
    given = {name: channel[0] for name, channel in masked.items()} if bare else masked
    rate = RATE if bare else None
    result = lissajous.reconstruct(given, device=Device.from_toml(DEVICE), pixels=(20, 20), sample_rate=rate)
    assert result.picture.coverage.sum() == np.sum(light >= 100.0)


@pytest.mark.parametrize("function", [lissajous.identify, lissajous.diagnose])
def test_no_recordings_are_refused(function: Callable) -> None:
    with pytest.raises(BadInput, match="recordings: holds none; give a recording, the path of one"):
        function([], "imaging")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"device": {"x": 1}}, "is a dict, no device"),
        ({"pixels": 400}, "pixels: is 400; give width and height"),
        ({"pixels": (50.5, 50)}, "pixels: is .50.5, 50.; give width and height"),
        ({"pixels": (50, 0)}, "pixels: is .50, 0.; give width and height"),
    ],
)
def test_arguments_of_a_wrong_type_are_named(arguments: dict, words: str) -> None:
    with pytest.raises(BadInput, match=words):
        lissajous.reconstruct(arrays(), **({"device": Device.from_toml(DEVICE)} | arguments))


@pytest.mark.parametrize("arguments", [{"count": 0}, {"count": -2}, {"frame_time": float("nan")}, {"z_step": -1e-6}])
def test_numbers_of_frames_are_positive(arguments: dict) -> None:
    result = lissajous.reconstruct(arrays(), device=Device.from_toml(DEVICE), pixels=(20, 20))
    with pytest.raises(BadInput, match="give a positive number"):
        lissajous.frames(result, **arguments)
    assert len(lissajous.frames(result, frame_time=1e9)) == 1


def test_a_target_is_not_scanned_by_a_device_of_one_axis(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    device = Device.from_toml(DEVICE + MECHANICS)
    one = replace(device, axes={"x": device.axes["x"]})
    (tmp_path / "one.toml").write_text(one.to_toml(), encoding="utf-8")
    words = "one.toml: y: is missing and needed here"
    refused(["simulate", "--device", str(tmp_path / "one.toml")], tmp_path, words, capsys)


def test_a_console_that_lacks_a_character_shows_another(monkeypatch: pytest.MonkeyPatch) -> None:
    written = BytesIO()
    monkeypatch.setattr(sys, "stdout", TextIOWrapper(written, encoding="cp1252"))
    with pytest.raises(SystemExit):
        main(["--version"])
    print("b/J = 10⁻² 1/s", flush=True)
    assert "b/J = 10?² 1/s" in written.getvalue().decode("cp1252")


def test_a_sensor_that_is_sampled_too_slowly_for_its_drive_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    def undersampled(file: h5py.File) -> None:
        """One sample of x in every 240: 2.08 in a period of 2000 Hz."""
        values("sense_x", lambda v: v[::240])(file)
        file["channels/sense_x"].attrs["sample_rate"] = RATE / 240

    write(tmp_path / "slow.h5", DEVICE + MECHANICS, undersampled)
    words = "slow.h5: sense_x: is sampled at 4167 Hz, too slowly for a motion at 2000 Hz; record at"
    refused(["reconstruct", str(tmp_path / "slow.h5"), "--estimator", "sensor"], tmp_path, words, capsys)


@pytest.mark.parametrize("step", [1, 320])
def test_a_sensor_shows_its_own_motion_where_its_drive_does_not(step: int, tmp_path: Path) -> None:
    """Drives without their beginning, and with 1.6 samples in a period: the amplitude was 0.001 of the true one."""

    def poor_drive(file: h5py.File) -> None:
        voltage = file["channels/drive_x"][::step]
        voltage[50 : 1000 // step] = np.nan
        del file["channels/drive_x"]
        drive = file.create_dataset("channels/drive_x", data=voltage)
        drive.attrs.update({"unit": "V", "sample_rate": RATE / step})

    write(tmp_path / "drive.h5", DEVICE + MECHANICS, poor_drive)
    result = lissajous.reconstruct(tmp_path / "drive.h5", estimator="sensor", pixels=(20, 20))
    assert float(np.median(result.motion.axes["x"].amplitude)) == pytest.approx(0.1, rel=0.02)
