"""Reconstruction of many recordings: one folder each, a table of all; a failure does not stop the others."""

import json
import os
import signal
import threading
import time
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile

from recon.cli import main
from recon.cli.reconstruct import format_summary
from recon.cli.reconstruct_many import reconstruct_files
from recon.runtime.fleet import find_recordings, plan_fleet
from recon.steps.reconstruction import Options
from scanner.errors import BadInput
from tests.support.simulated import imaging

OPTIONS = Options(estimator="constant", pixels=(60, 60))
ENTRIES = {"scan", "scan-2", "summary.json", "index.html", "job.json"}
ARGUMENTS = ["--estimator", "constant", "--pixels", "60x60"]


@pytest.fixture(scope="module")
def scans(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two recordings of the same name in different folders, and one without an intensity."""
    folder = tmp_path_factory.mktemp("scans")
    paths = [folder / "monday" / "scan.h5", folder / "tuesday" / "scan.h5", folder / "blind.h5"]
    for path, stop in zip(paths, (0.012, 0.016, 0.012), strict=True):
        path.parent.mkdir(exist_ok=True)
        imaging()[0].slice(0.0, stop).write(path)
    with h5py.File(paths[2], "r+") as file:
        del file["channels/intensity"]
    return paths


def test_a_picture_that_does_not_show_its_scene_is_named_among_others(
    scans: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = imaging()[0].slice(0.0, 0.012)
    light = recording["intensity"].read()
    bright = replace(recording["intensity"], raw=np.minimum(light, np.quantile(light, 0.3)), gain=1.0, offset=0.0)
    recording.with_channel(bright).write(tmp_path / "bright.h5")
    paths = [str(scans[0]), str(tmp_path / "bright.h5")]
    assert main(["reconstruct", *paths, "-o", str(tmp_path / "all"), *ARGUMENTS, "--workers", "1"]) == 0
    assert "the detector is saturated" in capsys.readouterr().out
    page = (tmp_path / "all" / "index.html").read_text(encoding="utf-8")
    assert "1 picture (bright) does not show the scene, or only a part" in page
    assert "bright: intensity:" in page


@pytest.mark.slow
def test_a_bad_recording_is_reported_and_the_others_are_reconstructed(
    scans: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "all"
    assert main(["reconstruct", *map(str, scans), "-o", str(out), *ARGUMENTS, "--json"]) == 2
    summary = json.loads(capsys.readouterr().out)
    assert json.loads((out / "summary.json").read_text()) == summary
    assert [Path(entry["output"]).name for entry in summary["recordings"]] == ["scan", "scan-2", "blind"]
    assert [bool(entry["failed"]) for entry in summary["recordings"]] == [False, False, True]
    assert "blind.h5: intensity: is not in the recording" in summary["recordings"][2]["failed"]
    assert {path.name for path in out.iterdir()} == ENTRIES
    page = (out / "index.html").read_text(encoding="utf-8")
    assert 'src="scan-2/image.png"' in page
    assert 'href="scan-2/report.html"' in page
    assert "blind.h5" in page
    assert main(["reconstruct", str(scans[1]), "-o", str(tmp_path / "alone"), *ARGUMENTS]) == 0
    for name in ("image.tif", "coverage.tif"):
        ours, alone = tifffile.imread(out / "scan-2" / name), tifffile.imread(tmp_path / "alone" / name)
        np.testing.assert_array_equal(ours, alone)
    lines = format_summary(summary).splitlines()
    assert lines[0].endswith("2 of 3 recordings reconstructed")
    assert "scan: fill" in lines[1]
    assert lines[3].startswith("  failed: ")


@pytest.mark.slow
def test_a_killed_worker_loses_nothing(scans: list[Path], tmp_path: Path) -> None:
    import multiprocessing

    def kill() -> None:
        while not (children := multiprocessing.active_children()):
            time.sleep(0.01)
        os.kill(children[0].pid, signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    summary = reconstruct_files(scans[:2], tmp_path / "all", OPTIONS, workers=1)
    killer.join()
    assert summary["exit"] == 0
    assert all((Path(entry["output"]) / "image.tif").is_file() for entry in summary["recordings"])


def test_a_worker_killed_during_submission_is_reported(
    scans: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> None:
        raise BrokenProcessPool("a child process terminated abruptly")

    monkeypatch.setattr(ProcessPoolExecutor, "submit", broken)
    summary = reconstruct_files(scans[:2], tmp_path / "all", OPTIONS, workers=1)
    assert summary["exit"] == 1
    assert all("its worker was killed" in entry["failed"] for entry in summary["recordings"])


@pytest.mark.slow
def test_recordings_are_reconstructed_on_a_dask_cluster(scans: list[Path], tmp_path: Path) -> None:
    import distributed

    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster:
        summary = reconstruct_files(scans[:2], tmp_path / "all", OPTIONS, scheduler=cluster.scheduler_address)
    assert summary["failed"] == 0
    assert {path.name for path in (tmp_path / "all").iterdir()} == ENTRIES


@pytest.mark.slow
def test_an_interrupted_run_continues_and_nothing_is_overwritten(scans: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "all"
    reconstruct_files(scans[:1], out, OPTIONS, workers=1)
    before = (out / "scan" / "image.tif").stat().st_mtime_ns
    summary = reconstruct_files([scans[1], scans[0]], out, OPTIONS, workers=1)  # another order, one more
    assert summary["kept"] == 1
    assert [Path(entry["output"]).name for entry in summary["recordings"]] == ["scan-2", "scan"]
    assert (out / "scan" / "image.tif").stat().st_mtime_ns == before
    with pytest.raises(BadInput, match="other options"):
        reconstruct_files(scans[:2], out, Options(estimator="constant", pixels=(50, 50)), workers=1)
    reconstruct_files(scans[:1], out, OPTIONS, workers=1, overwrite=True)
    assert (out / "scan" / "image.tif").stat().st_mtime_ns != before


def test_a_recording_that_changed_is_not_taken_as_done(tmp_path: Path) -> None:
    (tmp_path / "a.h5").write_bytes(b"first")
    fleet = plan_fleet([tmp_path / "a.h5"], tmp_path / "out", "options", "summary.json", False)
    folder = fleet.folders[tmp_path / "a.h5"]
    folder.mkdir()
    (folder / "summary.json").write_text("{}", encoding="utf-8")
    again = plan_fleet([tmp_path / "a.h5"], tmp_path / "out", "options", "summary.json", False)
    assert again.done == {tmp_path / "a.h5"}
    (tmp_path / "a.h5").write_bytes(b"second one")
    with pytest.raises(BadInput, match="has changed"):
        plan_fleet([tmp_path / "a.h5"], tmp_path / "out", "options", "summary.json", False)


def test_a_folder_without_recordings_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="holds no recording"):
        find_recordings([tmp_path])


def test_the_stack_of_an_earlier_run_does_not_stay_beside_new_results(tmp_path: Path) -> None:
    (tmp_path / "a.h5").write_bytes(b"no recording")  # a failed recording makes no stack
    out = tmp_path / "out"
    (out / "stack.ome.zarr").mkdir(parents=True)
    for name in ("stack.ome.tif", "stack_sd.ome.tif", "stack.mp4", "stack.gif", "notes.txt"):
        (out / name).write_text("of an earlier run", encoding="utf-8")
    assert reconstruct_files([tmp_path / "a.h5"], out, OPTIONS, workers=1)["exit"] == 2
    assert {path.name for path in out.iterdir()} == {"notes.txt", "summary.json", "index.html", "job.json"}
