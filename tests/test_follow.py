"""A recording that another process is still writing: its frames appear, and its end is what it is offline."""

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
import wholes
from worlds import imaging

from recon.cli import main
from recon.follow import continued, follow, repeat_time
from recon.pipeline import Options, reconstruct
from scanner.recording import Recording

PIXELS = ["--pixels", "100x100"]
WRITER = """
import sys, time
import h5py
source, path, parts, pause, end = sys.argv[1], sys.argv[2], int(sys.argv[3]), float(sys.argv[4]), sys.argv[5]
with h5py.File(source) as whole, h5py.File(path + ".new", "w", libver="latest") as file:
    import os
    file.attrs.update(whole.attrs)
    file.attrs["finished"] = 0
    file.create_group("device").attrs["toml"] = whole["device"].attrs["toml"]
    group, sizes = file.create_group("channels"), {}
    for name, channel in whole["channels"].items():
        made = group.create_dataset(name, (0,), channel.dtype, maxshape=(None,), chunks=(4096,))
        made.attrs.update(channel.attrs)
    file.swmr_mode = True
    os.rename(path + ".new", path)
    for k in range(parts):
        for name, channel in whole["channels"].items():
            first, stop = (channel.size * i // parts for i in (k, k + 1))
            group[name].resize((stop,))
            group[name][first:stop] = channel[first:stop]
            group[name].flush()
        time.sleep(pause)
    if end == "attribute":
        file.attrs["finished"] = 1
        file.flush()
        time.sleep(60)
    if end == "quiet":
        time.sleep(60)
"""


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A 20 ms scan, without its truth, and what the command makes of it in the folder beside it."""
    path = tmp_path_factory.mktemp("scan") / "scan.h5"
    imaging()[0].write(path)
    assert main(["reconstruct", str(path), "-o", str(path.parent / "offline"), *PIXELS]) == 0
    return path


@pytest.fixture
def written(scan: Path, tmp_path: Path):
    """Starts a process that writes the scan again, in parts; it is ended with the test."""
    started = []

    def start(parts: int = 10, pause: float = 0.3, end: str = "close") -> Path:
        path = tmp_path / "growing.h5"
        arguments = [str(scan), str(path), str(parts), str(pause), end]
        started.append(subprocess.Popen([sys.executable, "-c", WRITER, *arguments]))
        while end != "close" and not path.exists():  # on a busy machine it takes longer than the quiet time
            time.sleep(0.01)
        return path

    yield start
    for each in started:
        each.kill()
        each.wait()


def same(ours: Path, offline: Path) -> None:
    """Picture, coverage and motion are the same to the last bit."""
    for name in ("image.tif", "coverage.tif"):
        np.testing.assert_array_equal(tifffile.imread(ours / name), tifffile.imread(offline / name))
    with h5py.File(ours / "motion.h5") as a, h5py.File(offline / "motion.h5") as b:
        for axis in "xy":
            for key in ("phase", "amplitude", "phase_sd", "angle"):
                np.testing.assert_array_equal(a[axis][key], b[axis][key])


def test_frames_appear_while_it_is_written_and_the_end_is_the_offline_result(
    written, scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = written(), tmp_path / "out"
    seen: list[float] = []
    done = threading.Event()

    def watch() -> None:
        while not done.is_set():
            if (out / "image.tif").exists() and not (out / "summary.json").exists():
                seen.append(np.nanmean(tifffile.imread(out / "image.tif")))  # whole at any moment
            time.sleep(0.01)

    watcher = threading.Thread(target=watch)
    watcher.start()
    code = main(["reconstruct", "--follow", str(path), "-o", str(out), "--frame-time", "0.004", *PIXELS, "--json"])
    done.set()
    watcher.join()
    assert code == 0
    summary = json.loads(capsys.readouterr().out)
    live = summary["live"]
    assert live["frames"] >= 2
    assert live["frames"] + live["dropped"] == 5
    assert live["ended"] == "its writer closed the file"
    assert 0 < live["latency_s"]["median"] <= live["latency_s"]["max"] < 30
    assert len(set(seen)) >= 2
    assert np.isfinite(seen).all()
    same(out, scan.parent / "offline")


@pytest.mark.parametrize(
    ("end", "why"), [("attribute", "the file says that it is finished"), ("quiet", "nothing came")]
)
def test_a_writer_that_leaves_the_file_open(end: str, why: str, written, scan: Path, tmp_path: Path) -> None:
    arguments = ["--frame-time", "0.01", "--quiet-time", "1.5", *PIXELS]
    assert main(["reconstruct", "--follow", str(written(2, 0.1, end)), "-o", str(tmp_path / "out"), *arguments]) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["live"]["ended"].startswith(why)
    same(tmp_path / "out", scan.parent / "offline")


def test_an_interrupt_ends_the_following_and_keeps_what_there_is(written, tmp_path: Path) -> None:
    path, out = written(2, 0.1, "quiet"), tmp_path / "out"

    def interrupt() -> None:
        while not (out / "image.png").exists():
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=interrupt)
    thread.start()
    assert main(["reconstruct", "--follow", str(path), "-o", str(out), "--frame-time", "0.01", *PIXELS]) == 0
    thread.join()
    assert json.loads((out / "summary.json").read_text())["live"]["ended"] == "interrupted"


def test_a_frame_is_the_reconstruction_of_its_own_stretch(scan: Path, tmp_path: Path) -> None:
    live = follow(scan, tmp_path / "out", Options(pixels=(100, 100)), frame_time=0.015, quiet_time=0.1, quiet=True)
    assert (live.frames, live.dropped) == (1, 0)
    with Recording.open(scan) as recording:
        alone = reconstruct(recording.slice(0.0, 0.015), Options(pixels=(100, 100)), quiet=True)
    np.testing.assert_array_equal(tifffile.imread(tmp_path / "out" / "image.tif"), alone.picture.image)


def test_nothing_to_follow(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--quiet-time", "0.2", "-o", str(tmp_path / "out")]
    assert main(["reconstruct", "--follow", str(tmp_path / "none.h5"), *arguments]) == 2
    assert "no such file" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    assert main(["reconstruct", "--follow", str(tmp_path / "a.h5"), str(tmp_path / "b.h5"), *arguments]) == 2
    assert "follows one recording" in capsys.readouterr().err


def test_a_figure_repeats_when_both_axes_are_back() -> None:
    motion = reconstruct(imaging()[0], Options(pixels=(400, 400)), quiet=True).motion
    assert repeat_time(motion, 0.005) == pytest.approx(0.1, rel=1e-4)  # 13840 and 3270 Hz: 1384 and 327 periods
    assert repeat_time(motion, 1.5) == pytest.approx(1 / 3270, rel=1e-4)  # 4.23 periods are near enough to 4


def test_signs_go_on_from_frame_to_frame() -> None:
    recording, _ = imaging()
    first, second = (
        reconstruct(recording.slice(*part), Options(), quiet=True).motion for part in ((0.0, 0.008), (0.01, 0.02))
    )
    again = {name: axis.turned() for name, axis in second.axes.items()}
    for each in (second, type(second)(again, second.estimator)):
        motion = continued(each, first)
        for name in "xy":
            straight = first.axes[name].angle.motion.at(np.array([0.0101]))[0]
            assert np.cos(motion.axes[name].angle.motion.at(np.array([0.0101]))[0] - straight) > 0.9


def test_an_instruments_file_that_grows_is_followed_through_its_mapping(tmp_path: Path) -> None:
    wholes.recording(tmp_path / "whole.h5")
    names = ("sense_x", "sense_y", "intensity")
    with Recording.open(tmp_path / "whole.h5") as recording:
        table = np.stack([recording["sense_x"].time(), *(recording[name].read() for name in names)], axis=1)
        assert recording.device_toml is not None
        device = re.sub(r"^\[", "[device.", recording.device_toml, flags=re.MULTILINE)
    channels = (f'[channels.{name}]\nvariable = "{k + 1}"\nunit = "V"\n' for k, name in enumerate(names))
    (tmp_path / "map.toml").write_text("".join(channels) + device, encoding="utf-8")
    path = tmp_path / "scope.csv"

    def write() -> None:
        with path.open("w", encoding="utf-8") as file:
            file.write("x-axis,1,2,3\nsecond,Volt,Volt,Volt\n")
            for part in np.array_split(table, 4):
                np.savetxt(file, part, "%.9g", delimiter=",")
                file.flush()
                time.sleep(0.3)

    writer = threading.Thread(target=write)
    writer.start()
    mapping = ["--mapping", str(tmp_path / "map.toml")]
    arguments = [*mapping, "--frame-time", "0.005", "--quiet-time", "1", *PIXELS]
    assert main(["reconstruct", "--follow", str(path), "-o", str(tmp_path / "live"), *arguments]) == 0
    writer.join()
    assert main(["reconstruct", str(path), "-o", str(tmp_path / "offline"), *mapping, *PIXELS]) == 0
    live = json.loads((tmp_path / "live" / "summary.json").read_text())["live"]
    assert live["frames"] >= 1
    assert live["frames"] + live["dropped"] == 4
    same(tmp_path / "live", tmp_path / "offline")
