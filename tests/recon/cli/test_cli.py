"""The command line as a user runs it: output files, keys, exit codes, and one line for bad input."""

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile

from recon.cli import COMMANDS, add_command, main
from scanner.recording import Recording
from tests.support.simulated import imaging, separate_electrodes

FILES = {"image.tif", "image_sd.tif", "coverage.tif", "motion.h5", "summary.json", "report.html", "image.png"}


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A 20 ms scan of the tissue picture, both axes on one electrode, with truth."""
    path = tmp_path_factory.mktemp("scan") / "scan.h5"
    recording, truth = imaging()
    recording.write(path, truth)
    return path


def changed(scan: Path, folder: Path, change) -> Path:
    """A copy of the scan with its HDF5 changed."""
    path = folder / "changed.h5"
    path.write_bytes(scan.read_bytes())
    with h5py.File(path, "r+") as file:
        change(file)
    return path


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["kernel", "posterior"])
def test_a_picture_of_another_kind_comes_with_its_uncertainty(kind: str, scan: Path, tmp_path: Path) -> None:
    command = ["reconstruct", str(scan), "-o", str(tmp_path / "out"), "--pixels", "120x100", "--estimator", "ekf"]
    assert main([*command, "--picture", kind, "--frames", "4"]) == 0
    image, sd, share = (
        tifffile.imread(tmp_path / "out" / f"{name}.tif") for name in ("image", "image_sd", "data_share")
    )
    visited = tifffile.imread(tmp_path / "out" / "coverage.tif") > 0
    assert image.shape == sd.shape == share.shape == (100, 120)
    assert np.isfinite(image).mean() > 0.99
    assert (sd[np.isfinite(image)] > 0).all()
    assert np.array_equal(share > 0, visited)
    frames, deviations = (tifffile.imread(tmp_path / "out" / name) for name in ("frames.ome.tif", "frames_sd.ome.tif"))
    assert frames.shape == deviations.shape == (4, 100, 120)
    assert np.nanmedian(deviations) > np.nanmedian(sd)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["resolution_px"] > 1.0
    assert "share of a pixel" in (tmp_path / "out" / "report.html").read_text()


def test_a_posterior_picture_has_no_holes_to_fill(scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert main(["reconstruct", str(scan), "-o", str(tmp_path / "out"), "--picture", "posterior", "--fill", "2"]) == 2
    assert "--fill" in capsys.readouterr().err


def test_reconstruct_writes_the_documented_files_and_keys(
    scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    out = tmp_path / "out"
    assert main(["reconstruct", str(scan), "-o", str(out), "--json", "--estimator", "ekf", "--pixels", "200x160"]) == 0
    printed = capsys.readouterr()
    summary = json.loads(printed.out)
    assert {p.name for p in out.iterdir()} == FILES
    assert json.loads((out / "summary.json").read_text()) == summary
    image, coverage = tifffile.imread(out / "image.tif"), tifffile.imread(out / "coverage.tif")
    assert image.dtype == np.float32
    assert coverage.dtype == np.uint32
    assert image.shape == coverage.shape == (160, 200)
    assert np.array_equal(np.isnan(image), coverage == 0)
    assert summary["estimator"] == "ekf"
    assert summary["samples"] == coverage.sum()
    assert summary["fill"] == pytest.approx(np.mean(coverage > 0))
    for axis, m in (("x", 100), ("y", 80)):
        assert summary["bound_deg"][axis] == summary[axis]["bound_deg"] == pytest.approx(np.degrees(1 / m))
        assert 0 < summary["phase_sd_deg"][axis] < 0.5
        assert summary["phase_rmse_deg"][axis] < 0.2
        assert summary["within_bound"][axis] > 0.99
        assert summary["sign"][axis] == "ambiguous"
        assert 0 < summary["angle_rmse_rad"][axis] < 2e-3
    assert summary["seconds"] > 0
    times = summary["seconds_to_fill"]
    assert times["0.25"] < times["0.5"]
    assert times["0.99"] is None
    assert summary["fill"] < 0.99
    with h5py.File(out / "motion.h5") as motion:
        for axis in "xy":
            group = motion[axis]
            sizes = {group[key].size for key in ("time", "phase", "amplitude", "frequency", "phase_sd")}
            assert len(sizes) == 1
            assert group["angle"].attrs["sample_rate"] == 5e6
            assert group["angle"].attrs["start"] == 0.0
            assert group["angle"].size == 100_000
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "://" not in page.replace("http://www.w3.org", "")
    assert page.count("data:image") >= 4


@pytest.mark.slow
def test_a_prediction_concludes_and_states_its_folder(
    scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    assert main(["predict", str(scan), "-o", str(tmp_path / "out"), "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["conclusion"].startswith("From the drive alone ")
    assert summary["output"] == str(tmp_path / "out")
    assert json.loads((tmp_path / "out" / "summary.json").read_text()) == summary


def test_flips_mirror_the_picture(scan: Path, tmp_path: Path) -> None:
    common = ["reconstruct", str(scan), "--estimator", "constant"]
    main([*common, "-o", str(tmp_path / "plain")])
    main([*common, "-o", str(tmp_path / "flipped"), "--flip-x"])
    plain, flipped = (tifffile.imread(tmp_path / name / "coverage.tif") for name in ("plain", "flipped"))
    same = np.count_nonzero(plain[:, ::-1] == flipped) / plain.size
    assert same > 0.99  # a few samples on pixel edges are in the neighbouring pixel
    summary = json.loads((tmp_path / "flipped" / "summary.json").read_text())
    assert summary["sign"]["x"] == "known: --flip-x"
    assert summary["sign"]["y"] == "ambiguous"


@pytest.mark.slow
def test_the_reported_phase_error_of_the_picture_is_the_true_one(scan: Path, tmp_path: Path) -> None:
    main(["reconstruct", str(scan), "-o", str(tmp_path / "o"), "--estimator", "ekf"])
    summary = json.loads((tmp_path / "o" / "summary.json").read_text())
    for axis in "xy":
        phase_error = summary[axis]["picture_phase_error_deg"]
        assert abs(phase_error["value"] - summary[axis]["phase_bias_deg"]) < 0.05
        assert phase_error["sd"] < 0.02
        assert len(phase_error["slices"]) == 3
        assert [part["time"] for part in phase_error["slices"]] == pytest.approx([0.02 / 6, 0.01, 0.1 / 6], abs=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["ekf", "constant"])
def test_intensity_with_another_rate_and_start_is_aligned_by_its_times(method: str, tmp_path: Path) -> None:
    recording, truth = imaging()
    channels = {n: (c.read(), c.unit, c.sample_rate, c.start) for n, c in recording.channels.items()}
    first_sample = 1501  # then every second sample
    channels["intensity"] = (recording["intensity"].read()[first_sample::2], "V", 2.5e6, first_sample / 5e6)
    path = tmp_path / "other.h5"
    Recording.from_arrays(channels, recording.device).write(path, truth)
    assert main(["reconstruct", str(path), "-o", str(tmp_path / "out"), "--estimator", method]) == 0
    with h5py.File(tmp_path / "out" / "motion.h5") as motion:
        for axis in "xy":
            angle = motion[axis]["angle"]
            assert angle.attrs["start"] == first_sample / 5e6
            true = truth[f"angle_{axis}"][0][first_sample::2]
            start = slice(0, 2000)
            amplitude_error = np.abs(np.abs(np.dot(angle[start], true[start])) / np.dot(true[start], true[start]) - 1)
            assert amplitude_error < 0.02


@pytest.mark.slow
def test_each_axis_may_have_its_own_sense_signal(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    recording, truth = separate_electrodes()
    channels = {n: (c.read(), c.unit, c.sample_rate, c.start) for n, c in recording.channels.items()}
    channels["intensity"] = (np.sin(np.arange(60_000) / 50.0) + 2.0, "V", 5e6, 0.0)
    path = tmp_path / "separate.h5"
    Recording.from_arrays(channels, recording.device).write(path, truth)
    assert main(["reconstruct", str(path), "-o", str(tmp_path / "out"), "--json", "--estimator", "ukf"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert max(summary["phase_rmse_deg"].values()) < 0.2


@pytest.mark.slow
@pytest.mark.parametrize("keep", ["angles", "position"])
def test_recordings_of_angles_or_positions_are_reconstructed(
    keep: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    recording, truth = imaging()
    channels = {"intensity": (recording["intensity"].read(), "V", 5e6, 0.0)}
    device = recording.device
    for axis in "xy":
        angle = truth[f"angle_{axis}"][0]
        if keep == "angles":
            channels[f"angle_{axis}"] = (angle, "rad", 5e6, 0.0)
        else:
            noise = 1e-3 * np.random.default_rng(3).standard_normal(angle.size)
            channels[f"sense_{axis}"] = (2.0 + 10.0 * angle + noise, "V", 5e6, 0.0)
    if keep == "position":
        lines = [f'[{a}.readout]\nkind = "position"\ngain = 10.0\noffset = 2.0\nnoise_sd = 1e-3\n' for a in "xy"]
        text = 'name = "read"\n' + "".join(lines) + "[scan]\nhalf_angle_x = 0.18\nhalf_angle_y = 0.18\n"
        device = type(device).from_toml(text)
    path = tmp_path / "rec.h5"
    Recording.from_arrays(channels, device).write(path)
    assert main(["reconstruct", str(path), "-o", str(tmp_path / "out"), "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["estimator"] == "sensor"
    assert summary["sign"]["x"].startswith("known")
    image = tifffile.imread(tmp_path / "out" / "image.tif")
    main(["reconstruct", str(path), "-o", str(tmp_path / "again"), "--estimator", "sensor"])
    assert np.array_equal(image, tifffile.imread(tmp_path / "again" / "image.tif"), equal_nan=True)
    assert "phase_rmse_deg" not in summary


def refused(arguments: list[str], out: Path, capsys: pytest.CaptureFixture) -> str:
    """Run a command that has to be refused; return its message of one line."""
    code = main(arguments)
    captured = capsys.readouterr()
    assert code == 2
    assert captured.out == ""
    assert captured.err.count("\n") == 1, captured.err
    assert "Traceback" not in captured.err
    assert not out.exists()
    assert not [p for p in out.parent.iterdir() if p.name.endswith(".part")]
    return captured.err


def delete(*names: str):
    def change(file: h5py.File) -> None:
        for name in names:
            del file[f"channels/{name}"]

    return change


def attribute(name: str, key: str, value):
    return lambda file: file[f"channels/{name}"].attrs.__setitem__(key, value)


def put(name: str, at: slice, value: float):
    return lambda file: file[f"channels/{name}"].__setitem__(at, value)


def device_text(old: str, new: str):
    def change(file: h5py.File) -> None:
        text = file["device"].attrs["toml"]
        assert old in text
        file["device"].attrs["toml"] = text.replace(old, new)

    return change


BAD_RECORDINGS = {
    "no intensity": (delete("intensity"), ["intensity", "is not in the recording", "sense"]),
    "no sense and no drive": (delete("sense", "drive_x"), ["sense_x", "is not in the recording"]),
    "unknown unit": (attribute("sense", "unit", "bananas"), ["sense", "bananas", "accepted units: V"]),
    "NaN": (put("intensity", slice(None), np.nan), ["intensity", "no sample that can be used"]),
    "constant": (put("sense", slice(None), 1.5), ["sense", "is constant, 1.5 V"]),
    "negative rate": (attribute("drive_x", "sample_rate", -5e6), ["drive_x", "sample_rate"]),
    "another version": (lambda file: file.attrs.__setitem__("version", 7), ["version 7"]),
    "another format": (lambda file: file.attrs.__setitem__("format", "notes"), ["notes"]),
    "device without k": (device_text("k = 9.6e-06\n", ""), ["x.mechanics.k", "missing"]),
    "device with negative b": (device_text("b = ", "b = -"), ["x.mechanics.b"]),
    "rates that disagree": (attribute("drive_x", "sample_rate", 1e6), ["drive_x", "oscillates at 553", "sample_rate"]),
    "clocks that do not meet": (attribute("drive_x", "start", 5.0), ["drive_x", "covers"]),
    "no motion": (
        lambda file: file["channels/sense"].__setitem__(
            slice(None), 0.01 * np.random.default_rng(0).standard_normal(file["channels/sense"].size)
        ),
        ["sense", "shows no motion", "check drive"],
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("what", BAD_RECORDINGS)
def test_bad_recordings_are_refused_in_one_line(
    what: str, scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    change, words = BAD_RECORDINGS[what]
    path = changed(scan, tmp_path, change)
    line = refused(["reconstruct", str(path), "-o", str(tmp_path / "out")], tmp_path / "out", capsys)
    for word in [path.name, *words]:
        assert word in line, line


def test_files_that_are_no_recordings(scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    out = tmp_path / "out"
    for name, data in {"text.h5": b"hello", "empty.h5": b"", "cut.h5": scan.read_bytes()[:20_000]}.items():
        (tmp_path / name).write_bytes(data)
        assert name in refused(["reconstruct", str(tmp_path / name), "-o", str(out)], out, capsys)
    assert "absent.h5" in refused(["reconstruct", str(tmp_path / "absent.h5"), "-o", str(out)], out, capsys)


def test_bad_arguments_are_refused_in_one_line(scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    out = tmp_path / "out"
    rec = ["reconstruct", str(scan), "-o", str(out)]
    for extra in (["--pixels", "400"], ["--p", "-1"], ["--p", "nan"], ["--bananas"]):
        with pytest.raises(SystemExit) as stopped:
            main([*rec, *extra])
        captured = capsys.readouterr()
        assert stopped.value.code == 2
        assert captured.err.count("\n") == 1
    line = refused([*rec, "--estimator", "kalman"], out, capsys)
    assert "there are acm, constant" in line
    assert "no.toml" in refused([*rec, "--device", str(tmp_path / "no.toml")], out, capsys)
    assert "nowhere" in refused([*rec[:-1], str(tmp_path / "nowhere" / "out")], tmp_path / "out", capsys)


@pytest.mark.slow
def options(command: str) -> list[argparse.Action]:
    parser = argparse.ArgumentParser()
    add_command(command, parser)
    return parser._actions


@pytest.mark.parametrize("command", COMMANDS)
def test_every_option_refuses_numbers_that_no_quantity_has(command: str) -> None:
    for option in options(command):
        if option.type in (None, Path):
            continue
        count = len(option.metavar.split(",")) if isinstance(option.metavar, str) else 1
        for number in ("nan", "inf", "-inf", "1e30", "-1e30", "1e-30", "9" * 5000):
            with pytest.raises(argparse.ArgumentTypeError, match=r"is no|not"):
                option.type(",".join([number, *["1"] * (count - 1)]))  # type: ignore[operator]


@pytest.mark.parametrize("command", COMMANDS)
def test_empty_arguments_are_refused_in_one_line(command: str, capsys: pytest.CaptureFixture) -> None:
    for words, name in ((["-o", ""], "-o"), (["--terms="], "--terms"), ([""], "an argument"), (["a", " "], "an arg")):
        with pytest.raises(SystemExit) as stopped:
            main([command, *words])
        assert stopped.value.code == 2
        error = capsys.readouterr().err
        assert f"lissajous {command}: {name}" in error
        assert "is given an empty text" in error
        assert error.count("\n") == 1


def test_a_failed_run_does_not_change_earlier_results(scan: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    main(["reconstruct", str(scan), "-o", str(out), "--estimator", "constant"])
    before = {p.name: p.read_bytes() for p in out.iterdir()}
    assert main(["reconstruct", str(changed(scan, tmp_path, delete("intensity"))), "-o", str(out)]) == 2
    assert {p.name: p.read_bytes() for p in out.iterdir()} == before


@pytest.mark.slow
def test_text_of_a_recording_is_escaped_in_the_report(scan: Path, tmp_path: Path) -> None:
    path = changed(scan, tmp_path, lambda file: file.attrs.__setitem__("name", "<script>alert(1)</script>"))
    main(["reconstruct", str(path), "-o", str(tmp_path / "out"), "--estimator", "constant"])
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "<script>alert" not in page
    assert "&lt;script&gt;alert" in page


@pytest.mark.slow
def test_installed_commands_simulate_and_reconstruct(tmp_path: Path) -> None:
    bin_folder = Path(sys.executable).parent
    simulation = subprocess.run(
        [bin_folder / "lissajous", "simulate", "-o", tmp_path / "s.h5", "--duration", "0.01", "--json"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert json.loads(simulation.stdout)["channels"]["sense"] == 50_000
    reconstruction = subprocess.run(
        [bin_folder / "reconstruct-from-recording", tmp_path / "s.h5", "-o", tmp_path / "out"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert "report.html" in reconstruction.stdout
    assert {p.name for p in (tmp_path / "out").iterdir()} == FILES


def test_help_imports_no_large_library() -> None:
    command = [sys.executable, "-c", "import sys; from recon.cli import main; main(['--help'])"]
    times = []
    for _ in range(3):
        began = time.perf_counter()
        help_output = subprocess.run(command, capture_output=True, text=True)
        times.append(time.perf_counter() - began)
    assert "reconstruct" in help_output.stdout
    heavy = subprocess.run(
        [sys.executable, "-c", "import sys, recon.cli; print(sorted({'numpy', 'scipy', 'numba'} & set(sys.modules)))"],
        capture_output=True, text=True,
    )  # fmt: skip
    assert heavy.stdout.strip() == "[]"


def test_version_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    import lissajous

    with pytest.raises(SystemExit, match="0"):
        main(["--version"])
    assert capsys.readouterr().out == f"lissajous {lissajous.__version__}\n"
