"""Further wrong or unusual inputs: each is used as it was meant, or ends in one line or a note with the cause."""

from __future__ import annotations

import gzip
from pathlib import Path

import h5py
import numpy as np
import pytest

from recon.cli import main
from recon.io.readers import read
from scanner.device import Device
from scanner.errors import BadInput
from scanner.files import read_toml
from tests.support.wrong_inputs import (
    DEVICE,
    DRIVES,
    FIELD,
    RATE,
    SAMPLES,
    SENSES,
    Change,
    attribute,
    edges,
    refused,
    values,
    write,
)


def stored(channel: str, data: object) -> Change:
    return values(channel, lambda _: np.asarray(data))


def gaps_in_a_constant(light: np.ndarray) -> np.ndarray:
    constant = np.full(light.size, 3.0)
    constant[2000:6000] = np.nan
    return constant


def edge_times(change) -> Change:  # type: ignore[no-untyped-def]
    def apply(file: h5py.File) -> None:
        edges()(file)
        values("sync_x", change)(file)

    return apply


TOLERANCE = DEVICE + "[x.tolerance]\ngain = {}\n"
RECORDINGS: dict[str, tuple[str, Change | None, str]] = {
    "constant with gaps": (DEVICE, values("intensity", gaps_in_a_constant), "intensity: is constant, 3 V"),
    "no dimension": (DEVICE, stored("intensity", 3.0), "intensity: has shape (); store it as (n,) or (n, detectors)"),
    "texts": (DEVICE, stored("intensity", np.array([b"a", b"b"])), "intensity: holds |S1, not real numbers"),
    "truth values": (DEVICE, values("sense_x", lambda v: v > 0.0), "sense_x: holds bool, not real numbers"),
    "differences that underflow": (
        DEVICE, values("intensity", lambda v: 1e-312 * v), "intensity: changes by 9.95e-311 V only; check its type"),
    "sensor as a column": (DEVICE, values("sense_x", lambda v: v[:, None]), "sense_x: has shape (20000, 1); store"),
    "rate of two numbers": (
        DEVICE, attribute("intensity", "sample_rate", [1e6, 2e6]), "not a finite number; state sample_rate"),
    "start as text": (DEVICE, attribute("intensity", "start", "0 s"), "intensity: start is '0 s'"),
    "channel in capitals": (
        DEVICE, lambda file: file.move("channels/sense_x", "channels/Sense_X"),
        "neither is sense_x; choose another estimator, record it, or state frequency in [x.drive]; it holds Sense_X,"),
    "blank at the end of a name": (
        DEVICE, lambda file: file.move("channels/sense_x", "channels/sense_x "), "sense_x ; is it sense_x?"),
    "detectors of one name": (
        DEVICE, lambda file: (values("intensity", lambda v: np.stack([v, v], 1))(file),
        attribute("intensity", "detectors", ["a", "a"])(file)), "give 2 different names, one for each detector"),
    "tolerance as text": (TOLERANCE.format('"5 %"'), None, "x.tolerance.gain: is '5 %' and must be a number, 0 or"),
    "edges in falling order": (FIELD, edge_times(lambda t: t[::-1]), "sync_x: edge 1 at 0.019 s is earlier"),
    "an edge that is no number": (
        FIELD, edge_times(lambda t: np.where(t == t[3], np.nan, t)), "sync_x: edge 3 is not finite"),
    "edges in ticks": (FIELD, edge_times(lambda t: np.round(t * RATE)), "1 of its 40 edges lie between 0 s and 0.02 s"),
    "every edge twice": (FIELD, edge_times(lambda t: np.repeat(t, 2)), "40 repeated; check the detector's threshold"),
}  # fmt: skip


@pytest.mark.parametrize("case", RECORDINGS)
def test_a_recording_is_refused_in_one_line(case: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    device, change, words = RECORDINGS[case]
    write(tmp_path / "scan.h5", device, change, DRIVES if "readout" in device else (*DRIVES, *SENSES))
    refused(["reconstruct", str(tmp_path / "scan.h5"), "--pixels", "40x40"], tmp_path, words, capsys)


NOTED: dict[str, tuple[str, Change | None, str | None]] = {
    "integers of the other byte order": (DEVICE, values("intensity", lambda v: np.round(v).astype(">i2")), None),
    "a tolerance of no value": (
        TOLERANCE.replace("gain = {}", "Gain = 0.05"), None, "x.tolerance.Gain: is the tolerance of no value"),
    "a tolerance in percent": (TOLERANCE.format(5), None, "x.tolerance.gain: is 5, that is 500%; it is relative: 5 %"),
    "infinite samples": (
        DEVICE, values("intensity", lambda v: np.where(v > 120.0, np.inf, v)), "7.4% of the samples are infinite"),
    "intensity of another rate and start": (
        DEVICE, lambda file: (values("intensity", lambda v: v[4000::2])(file),
        attribute("intensity", "sample_rate", RATE / 2)(file), attribute("intensity", "start", 0.004)(file)),
        "intensity: covers 80% of the recording"),
}  # fmt: skip


@pytest.mark.parametrize("case", NOTED)
def test_an_unusual_recording_makes_a_picture(case: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    device, change, words = NOTED[case]
    write(tmp_path / "scan.h5", device, change, DRIVES)
    assert main(["reconstruct", str(tmp_path / "scan.h5"), "--pixels", "40x40", "-o", str(tmp_path / "out")]) == 0
    captured = capsys.readouterr().out
    assert words is None or words in captured, captured


FILES: dict[str, tuple[str, bytes, str]] = {
    "compressed": ("scope.csv", gzip.compress(b"Time (s),CH1 (V)\n"), "is compressed (gzip); unpack it first"),
    "spreadsheet": ("scope.xlsx", b"PK\x03\x04" + bytes(40), "is a spreadsheet; save the table as CSV"),
    "old spreadsheet": ("scope.xls", b"\xd0\xcf\x11\xe0" + bytes(40), "is a document of Microsoft Office"),
    "document": ("scope.pdf", b"%PDF-1.4\n", "is a PDF document; export the samples"),
    "two columns of times": (
        "scope.csv", b"Time (s),CH1 (V),Time (s)\n" + b"".join(b"%de-6,%d,%de-6\n" % (k, k, k) for k in range(40)),
        "Time (1) and Time (2) are times: choose those of the channel by --time"),
}  # fmt: skip


@pytest.mark.parametrize("case", FILES)
def test_a_file_is_refused_in_one_line(case: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    name, content, words = FILES[case]
    (tmp_path / name).write_bytes(content)
    refused(["convert", str(tmp_path / name), "--channel", "sense_x=CH1"], tmp_path, words, capsys)


@pytest.mark.parametrize("encoding", ["cp1252", "utf-8", "utf-8-sig", "utf-16"])
def test_units_are_read_in_the_encodings_of_instruments(encoding: str, tmp_path: Path) -> None:
    rows = "".join(f"{k},{k % 7}\n" for k in range(40))
    (tmp_path / "scope.csv").write_bytes(f"Time (µs),CH1 (V)\n{rows}".encode(encoding))
    assert read(tmp_path / "scope.csv").variables["CH1"].sample_rate == pytest.approx(1e6)


def test_blanks_beside_the_name_of_a_channel_are_no_part_of_it(tmp_path: Path) -> None:
    (tmp_path / "scope.csv").write_text("Time (s),CH1 (V)\n" + "".join(f"{k}e-6,{k % 7}\n" for k in range(40)))
    assert (
        main(["convert", str(tmp_path / "scope.csv"), "--channel", " sense_x = CH1 ", "-o", str(tmp_path / "o.h5")])
        == 0
    )
    with h5py.File(tmp_path / "o.h5") as file:
        assert list(file["channels"]) == ["sense_x"]


def test_a_device_file_of_a_windows_editor_is_read(tmp_path: Path) -> None:
    (tmp_path / "device.toml").write_text("\ufeff" + DEVICE, encoding="utf-8")
    assert Device.load(tmp_path / "device.toml").scan == Device.from_toml(DEVICE).scan


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("half_angle_x = 0,11", "write the number of 'half_angle_x = 0,11' with a point"),
        ("half_angle_x : 0.11", "correct the line 'half_angle_x : 0.11'"),
    ],
)
def test_a_line_that_is_no_toml_is_quoted(line: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "device.toml").write_text(f"[scan]\n{line}\n", encoding="utf-8")
    with pytest.raises(BadInput) as error:
        read_toml(tmp_path / "device.toml")
    assert words in str(error.value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda r: np.where(np.arange(r.size) % 5 == 0, np.inf, r), "4000 values of infinity, taken as no return"),
        (lambda r: np.where(np.arange(r.size) % 5 == 0, -1.0, r), "4000 values of 0 or less, taken as no return"),
    ],
)
def test_shots_without_a_range_are_counted(change, words: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:  # type: ignore[no-untyped-def]
    def add(file: h5py.File) -> None:
        ranges = 8.0 + 0.01 * np.random.default_rng(61_450).normal(size=SAMPLES)
        file.create_dataset("channels/range", data=change(ranges)).attrs.update({"unit": "m", "sample_rate": RATE})

    write(tmp_path / "scan.h5", DEVICE, add, DRIVES)
    assert main(["point-cloud", str(tmp_path / "scan.h5"), "-o", str(tmp_path / "out")]) == 0
    captured = capsys.readouterr().out
    assert words in captured
    assert "millimetres" not in captured


@pytest.mark.parametrize("command", ["diagnose", "identify"])
def test_a_recording_given_twice_is_not_two_measurements(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    write(tmp_path / "scan.h5", DEVICE, None, DRIVES)
    again = tmp_path / "." / "scan.h5"
    refused(
        [command, str(tmp_path / "scan.h5"), str(again)], tmp_path, "is given twice; name each recording once", capsys
    )


def test_a_simulation_with_too_few_steps_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    words = "1000 samples a second are too few for x, of a resonance of 13763.7 Hz; simulate with 55055 or more"
    refused(["simulate", "--rate", "1000", "--duration", "0.01"], tmp_path, words, capsys)


@pytest.mark.parametrize(
    ("stated", "phase", "count"),
    [
        (["--event", "sync_x=zero-crossing-up"], 0.0, 20),
        (["--event", "sync_x=zero-crossing-down"], 0.5, 20),
        (["--angle", "sync_x=0.0"], None, 40),
    ],
)
def test_a_sampled_sync_signal_gives_its_edges(
    stated: list[str], phase: float | None, count: int, tmp_path: Path
) -> None:
    rng, time = np.random.default_rng(61_460), np.arange(10_000) / RATE
    sync = 5.0 / (1.0 + np.exp(-np.sin(2 * np.pi * 2000.0 * (time - 1e-4)) / 0.03))  # rises within some samples
    lines = (f"{t:.7g},{v:.5g}\n" for t, v in zip(time, sync + rng.normal(0.0, 0.05, time.size), strict=True))
    (tmp_path / "scope.csv").write_text("Time (s),CH1 (V)\n" + "".join(lines))
    arguments = ["--channel", "sync_x=CH1", *stated, "-o", str(tmp_path / "o.h5")]
    assert main(["convert", str(tmp_path / "scope.csv"), *arguments]) == 0
    with h5py.File(tmp_path / "o.h5") as file:
        times = file["channels/sync_x"][:]
    assert times.size == pytest.approx(count, abs=1)
    periods = 2000.0 * (times - 1e-4)
    step = 1.0 if phase is not None else 0.5
    error = (periods - (phase or 0.0)) / step
    assert np.abs(error - np.round(error)).max() * step / 2000.0 < 0.5e-6


def test_a_velocity_in_metres_needs_the_distance_from_the_axis(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    (tmp_path / "ldv.csv").write_text("Time (s),CH1 (m/s)\n" + "".join(f"{k}e-6,{k % 7}\n" for k in range(40)))
    words = "velocity_x: unit 'm/s' is unknown; accepted units: rad/s, mrad/s, deg/s; divide a motion in metres by"
    refused(["convert", str(tmp_path / "ldv.csv"), "--channel", "velocity_x=CH1"], tmp_path, words, capsys)


def test_a_sync_signal_needs_its_event(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    (tmp_path / "scope.csv").write_text("Time (s),CH1 (V)\n" + "".join(f"{k}e-6,{k % 7}\n" for k in range(40)))
    words = "sync_x: states neither event nor angle; state event as one of zero-crossing-up"
    refused(["convert", str(tmp_path / "scope.csv"), "--channel", "sync_x=CH1"], tmp_path, words, capsys)
