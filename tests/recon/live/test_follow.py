"""Following a recording that another process writes: frames appear, and the final result equals the offline one."""

import itertools
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

from recon.cli import main
from recon.live.follow import follow_recording, repeat_time
from recon.live.growing_recording import Snapshot
from recon.live.live_frames import (
    add_part,
    next_measurement,
)
from recon.pipeline import reconstruct
from recon.steps.notes import describe_live_frames
from recon.steps.reconstruction import Options
from scanner.recording import Recording
from tests.support import sample_files
from tests.support.simulated import imaging

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
    """A 20 ms scan without its truth. The folder ``offline`` beside it has its reconstruction."""
    path = tmp_path_factory.mktemp("scan") / "scan.h5"
    imaging()[0].write(path)
    assert main(["reconstruct", str(path), "-o", str(path.parent / "offline"), *PIXELS]) == 0
    return path


@pytest.fixture
def written(scan: Path, tmp_path: Path):
    """A function that starts a process which writes the scan in parts; the process is killed after the test."""
    processes = []

    def start(parts: int = 10, pause: float = 0.3, end: str = "close") -> Path:
        path = tmp_path / "growing.h5"
        arguments = [str(scan), str(path), str(parts), str(pause), end]
        processes.append(subprocess.Popen([sys.executable, "-c", WRITER, *arguments]))
        while end != "close" and not path.exists():  # on a busy machine it takes longer than the quiet time
            time.sleep(0.01)
        return path

    yield start
    for process in processes:
        process.kill()
        process.wait()


def assert_same_result(ours: Path, offline: Path) -> None:
    """Assert that picture, coverage and motion are identical."""
    for name in ("image.tif", "coverage.tif"):
        np.testing.assert_array_equal(tifffile.imread(ours / name), tifffile.imread(offline / name))
    with h5py.File(ours / "motion.h5") as a, h5py.File(offline / "motion.h5") as b:
        for axis in "xy":
            for key in ("phase", "amplitude", "phase_sd", "angle"):
                np.testing.assert_array_equal(a[axis][key], b[axis][key])


@pytest.mark.slow
def test_frames_appear_during_writing_and_the_final_result_is_the_offline_one(
    written, scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = written(), tmp_path / "out"
    frame_means: list[float] = []
    finished = threading.Event()

    def watch() -> None:
        while not finished.is_set():
            if (out / "image.tif").exists() and not (out / "summary.json").exists():
                frame_means.append(np.nanmean(tifffile.imread(out / "image.tif")))  # a complete file at any time
            time.sleep(0.01)

    watcher = threading.Thread(target=watch)
    watcher.start()
    code = main(["reconstruct", "--follow", str(path), "-o", str(out), "--frame-time", "0.004", *PIXELS, "--json"])
    finished.set()
    watcher.join()
    assert code == 0
    summary = json.loads(capsys.readouterr().out)
    live = summary["live"]
    assert live["frames"] >= 2
    assert live["frames"] + live["dropped"] == 5
    assert live["ended"] == "its writer closed the file"
    assert 0 < live["latency_s"]["median"] <= live["latency_s"]["max"] < 30
    assert len(set(frame_means)) >= 2
    assert np.isfinite(frame_means).all()
    assert_same_result(out, scan.parent / "offline")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("end", "why"), [("attribute", "the file says that it is finished"), ("quiet", "nothing came")]
)
def test_following_ends_when_the_writer_leaves_the_file_open(
    end: str, why: str, written, scan: Path, tmp_path: Path
) -> None:
    arguments = ["--frame-time", "0.01", "--quiet-time", "1.5", *PIXELS]
    assert main(["reconstruct", "--follow", str(written(2, 0.1, end)), "-o", str(tmp_path / "out"), *arguments]) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["live"]["ended"].startswith(why)
    assert_same_result(tmp_path / "out", scan.parent / "offline")


@pytest.mark.slow
def test_an_interrupt_ends_the_following_and_keeps_the_frames(written, tmp_path: Path) -> None:
    path, out = written(2, 0.1, "quiet"), tmp_path / "out"

    def interrupt() -> None:
        while not (out / "image.png").exists():
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=interrupt)
    thread.start()
    arguments = ["--frame-time", "0.01", "--quiet-time", "60", *PIXELS]  # compilation takes longer than the usual 5 s
    assert main(["reconstruct", "--follow", str(path), "-o", str(out), *arguments]) == 0
    thread.join()
    assert json.loads((out / "summary.json").read_text())["live"]["ended"] == "interrupted"


def test_each_part_begins_where_the_one_before_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recording, _ = imaging(0.15)  # its frequencies drift, and with them the period from which the parts follow
    recording.write(tmp_path / "scan.h5")
    parts = []

    def record(recording: Recording, start: float, stop: float, *rest: object) -> object:
        parts.append((start, stop))
        return add_part(recording, start, stop, *rest)

    monkeypatch.setattr("recon.live.follow.add_part", record)
    options = Options(pixels=(50, 50))
    follow_recording(tmp_path / "scan.h5", tmp_path / "out", options, frame_time=0.07, quiet_time=0.1, quiet=True)
    assert len(parts) == 4  # a frame without an earlier one has one part, the next one has three
    assert all(stop == start for (_, stop), (start, _) in itertools.pairwise(parts))


def test_frames_of_a_finished_recording_are_not_called_too_fast_for_the_machine(scan: Path, tmp_path: Path) -> None:
    options = Options(pixels=(50, 50))
    live = follow_recording(scan, tmp_path / "out", options, frame_time=0.004, quiet_time=0.1, quiet=True)
    assert (live.frames, live.dropped, live.overtaken, live.recorded_before) == (1, 4, 0, 4)
    (note,) = describe_live_frames(live.summary())
    assert "4 of 5 were complete when the recording was opened" in note
    without_motion = {"dropped": 4, "recorded_before": 0}
    assert describe_live_frames(live.summary() | without_motion) == []


def test_frames_that_newer_ones_overtake_are_counted_and_stated(
    scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = Recording.open(scan)
    snapshots = [Snapshot(whole.slice(0.0, 0.003), None, 0.0), Snapshot(whole, "closed", 0.0)]
    monkeypatch.setattr("recon.live.follow.poll_recording", lambda *_: iter(snapshots))
    live = follow_recording(scan, tmp_path / "out", Options(pixels=(50, 50)), frame_time=0.004, quiet=True)
    assert (live.frames, live.dropped, live.overtaken, live.recorded_before) == (1, 4, 4, 0)
    (note,) = describe_live_frames(live.summary())
    assert "4 of 5, because newer ones had arrived" in note


def test_a_channel_that_nothing_uses_neither_ends_nor_delays_the_frames(scan: Path, tmp_path: Path) -> None:
    channels = {n: (c.read(), c.unit, c.sample_rate, c.start) for n, c in Recording.open(scan).channels.items()}
    channels["temperature"] = (np.full(100, 293.0), "K", 1e6, 0.001)  # of a scan of 20 ms from 0 s
    Recording.from_arrays(channels, Recording.open(scan).device).write(tmp_path / "warm.h5")
    options = Options(pixels=(50, 50))
    live = follow_recording(
        tmp_path / "warm.h5", tmp_path / "out", options, frame_time=0.01, quiet_time=0.1, quiet=True
    )
    assert live.frames + live.dropped == 2
    assert live.shown[-1][0] == pytest.approx(0.02)


def test_the_readout_error_is_measured_ever_more_rarely_and_never_stops() -> None:
    measured = [1]
    while measured[-1] < 256:
        measured.append(next_measurement(measured[-1]))
    assert measured == [1, 2, 4, 8, 16, 32, 64, 128, 192, 256]


@pytest.mark.slow
def test_the_first_frame_is_the_sense_only_reconstruction_of_its_segment(scan: Path, tmp_path: Path) -> None:
    live = follow_recording(
        scan, tmp_path / "out", Options(pixels=(100, 100)), frame_time=0.015, quiet_time=0.1, quiet=True
    )
    assert (live.frames, live.dropped) == (1, 0)
    sensed = Options(pixels=(100, 100), sense_only=True)  # no earlier frame has measured the readout's phase error
    with Recording.open(scan) as recording:
        alone = reconstruct(recording.slice(0.0, 0.015), sensed, quiet=True)
    np.testing.assert_array_equal(tifffile.imread(tmp_path / "out" / "image.tif"), alone.picture.image)


def test_a_missing_file_and_two_files_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--quiet-time", "0.2", "-o", str(tmp_path / "out")]
    assert main(["reconstruct", "--follow", str(tmp_path / "none.h5"), *arguments]) == 2
    assert "no such file" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    assert main(["reconstruct", "--follow", str(tmp_path / "a.h5"), str(tmp_path / "b.h5"), *arguments]) == 2
    assert "follows one recording" in capsys.readouterr().err
    assert main(["reconstruct", str(tmp_path / "a.h5"), *arguments]) == 2
    assert "--quiet-time: has no effect without --follow" in capsys.readouterr().err


def test_the_figure_repeats_after_whole_periods_of_both_axes() -> None:
    motion = reconstruct(imaging()[0], Options(pixels=(400, 400)), quiet=True).motion
    assert repeat_time(motion, 0.005) == pytest.approx(0.1, rel=1e-4)  # 13840 and 3270 Hz: 1384 and 327 periods
    assert repeat_time(motion, 1.5) == pytest.approx(1 / 3270, rel=1e-4)  # 4.23 periods are near enough to 4


@pytest.mark.slow
def test_a_growing_instrument_file_is_followed_with_its_mapping(tmp_path: Path) -> None:
    sample_files.recording(tmp_path / "whole.h5")
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
    assert_same_result(tmp_path / "live", tmp_path / "offline")
