"""Blur studies: every cell once, none twice, none lost, and numbers that a single reconstruction gives too."""

import csv
import fcntl
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from study_worlds import CELLS, small_study

from recon.cli import main
from recon.pipeline import Options, reconstruct
from recon.score import told_truth
from recon.study.plan import jobs, key, read_study, remaining
from recon.study.table import NAMES, columns, rows
from recon.study.world import do, record, sense_rms
from recon.summary import summarise
from scanner.device import Device
from scanner.errors import BadInput

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the small study, done on one worker."""
    folder = tmp_path_factory.mktemp("study")
    assert main(["blur-study", str(small_study(folder)), "-o", str(folder / "out"), "--workers", "1", "--parquet"]) == 0
    return folder / "out"


def journal(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / "cells.jsonl").read_text().splitlines()]


def assert_whole(folder: Path) -> None:
    """Every cell of the small study stands in journal and table, once."""
    cells = Counter(key(each["cell"]) for each in journal(folder))
    assert len(cells) == CELLS
    assert set(cells.values()) == {1}
    with (folder / "table.csv").open() as file:
        table = list(csv.DictReader(file))
    assert len(table) == 2 * CELLS
    assert len({tuple(row[name] for name in (*NAMES[:8], "axis")) for row in table}) == 2 * CELLS


def test_a_study_writes_table_summary_and_report(done: Path) -> None:
    assert {path.name for path in done.iterdir()} == {
        "cells.jsonl", "table.csv", "table.parquet", "summary.json", "report.html", "study.toml",
    }  # fmt: skip
    assert_whole(done)
    summary = json.loads((done / "summary.json").read_text())
    assert (summary["cells"], summary["computed"], summary["failed"]) == (CELLS, CELLS, 0)
    assert (
        summary["estimators"]["tracker"]["phase_rmse_deg_median"]
        < summary["estimators"]["constant"]["phase_rmse_deg_p95"]
    )
    page = (done / "report.html").read_text()
    assert page.count('src="data:image/svg') == 3
    assert "http" not in page.replace("http://www.w3.org", "")


def test_parquet_holds_what_csv_holds(done: Path) -> None:
    from pyarrow import parquet

    table = parquet.read_table(done / "table.parquet").to_pylist()
    with (done / "table.csv").open() as file:
        for row, text in zip(table, csv.DictReader(file), strict=True):
            assert {name: "" if value is None else str(value) for name, value in row.items()} == {
                name: str(float(value)) if isinstance(row[name], float) else value for name, value in text.items()
            }


def test_a_cell_is_what_the_pipeline_gives(done: Path) -> None:
    found = next(each for each in journal(done) if each["cell"]["estimator"] == "tracker" and each["cell"]["p"] == 0.5)
    world = next(
        job.world
        for job in jobs(read_study(done / "study.toml"))
        if (job.world.drift, job.world.seed) == (found["cell"]["drift"], found["cell"]["seed"])
    )
    recording, told = record(world)
    options = Options(estimator="tracker", pixels=(100, 100), p=0.5)
    result = reconstruct(recording, options, told_truth(told), quiet=True)
    summary = summarise(result)
    for axis in "xy":
        assert found[axis]["phase_rmse_deg"] == pytest.approx(summary[axis]["phase_rmse_deg"], rel=1e-9)
        assert found[axis]["bound_deg"] == pytest.approx(np.degrees(0.5 / 50))
        assert found[axis]["within_bound"] == summary[axis]["within_bound"]
        assert found[axis]["blur_total_px"] == pytest.approx(summary[axis]["blur_px"]["total"], rel=1e-9)
    assert found["picture_error"] == pytest.approx(summary["picture"]["rms"], rel=1e-9)
    assert found["fill"] == summary["fill"]


def test_a_finished_study_is_not_done_again(done: Path, capsys: pytest.CaptureFixture) -> None:
    before = (done / "cells.jsonl").read_bytes()
    assert main(["blur-study", str(done / "study.toml"), "-o", str(done), "--json"]) == 0
    told = capsys.readouterr()
    assert json.loads(told.out)["computed"] == 0
    assert told.err == ""
    assert (done / "cells.jsonl").read_bytes() == before


def test_only_what_a_changed_study_lacks_is_left(done: Path, tmp_path: Path) -> None:
    have = {key(each["cell"]): each for each in journal(done)}

    def left(old: str, new: str) -> int:
        return sum(len(list(job.cells())) for job in remaining(jobs(read_study(small_study(tmp_path, old, new))), have))

    assert left("", "") == 0
    assert left("seeds = 2", "seeds = 3") == CELLS // 2
    assert left("drifts = [0.0, -0.001]", "drifts = [-0.001]") == 0
    assert left("pixels = [100]", "pixels = [100, 60]") == CELLS
    assert left("27680.0", "27690.0") == CELLS  # another drive under the same name
    assert left("duration = 0.004", "duration = 0.005") == CELLS


def test_a_journal_cut_anywhere_loses_no_more_than_its_last_cell(done: Path, tmp_path: Path) -> None:
    text = (done / "cells.jsonl").read_bytes()
    (tmp_path / "cut").mkdir()
    (tmp_path / "cut" / "cells.jsonl").write_bytes(text[: len(text) * 7 // 8])
    whole = text[: len(text) * 7 // 8].count(b"\n")
    assert main(["blur-study", str(done / "study.toml"), "-o", str(tmp_path / "cut"), "--workers", "1"]) == 0
    summary = json.loads((tmp_path / "cut" / "summary.json").read_text())
    assert CELLS - whole <= summary["computed"] <= CELLS - whole + 1
    again, first = (
        {key(each["cell"]): each | {"seconds": 0} for each in journal(folder)} for folder in (tmp_path / "cut", done)
    )
    assert again == first


def test_killed_midway_nothing_is_lost_and_no_worker_stays(tmp_path: Path) -> None:
    study = small_study(tmp_path)
    command = [sys.executable, "-m", "recon", "blur-study", str(study), "-o", str(tmp_path / "out"), "--workers", "2"]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL, start_new_session=True, cwd=ROOT)
    lines = tmp_path / "out" / "cells.jsonl"
    until(lambda: lines.exists() and lines.stat().st_size > 0)
    process.kill()
    process.wait()
    before = lines.read_bytes()
    assert before
    until(lambda: not group_lives(process.pid))
    assert not (tmp_path / "out" / "summary.json").exists()
    assert main(["blur-study", str(study), "-o", str(tmp_path / "out"), "--workers", "1"]) == 0
    assert_whole(tmp_path / "out")
    assert lines.read_bytes().startswith(before[: before.rfind(b"\n") + 1])


def until(holds, seconds: float = 300.0) -> None:
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.02)


def group_lives(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


def test_two_runs_do_not_share_a_folder(done: Path, capsys: pytest.CaptureFixture) -> None:
    with (done / "cells.jsonl").open("ab") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        assert main(["blur-study", str(done / "study.toml"), "-o", str(done)]) == 2
    assert "another run" in capsys.readouterr().err


def test_an_estimator_that_fails_is_a_result(tmp_path: Path) -> None:
    # A drive that cannot hold the motion: nothing to reconstruct, in any of the ways.
    study = read_study(small_study(tmp_path, "27680.0, 30.0, 30.0", "27680.0, 3.0, 3.0"))
    records = do(next(iter(jobs(study))))
    assert len(records) == 4
    assert all("does not sustain" in each["failed"] for each in records)
    data = columns(rows(records))
    assert np.isnan(data["phase_rmse_deg"]).all()


@settings(max_examples=5)
@given(st.floats(-10.0, 40.0))
def test_noise_stands_as_far_below_the_signal_as_asked(snr_db: float) -> None:
    with tempfile.TemporaryDirectory() as folder:
        world = next(iter(jobs(read_study(small_study(Path(folder)))))).world
    clean = sense_rms(world.design, world.recording.sample_rate)["sense"]
    recording, _ = record(replace(world, snr_db=snr_db))
    noise = Device.from_toml(recording.device_toml).readout.noise_sd
    assert 20 * np.log10(clean / noise) == pytest.approx(snr_db)
    # Neighbouring samples differ by the motion, which is smooth, and by the noise, which is not.
    measured = np.std(np.diff(recording["sense"].read(), 6)) / np.sqrt(924)
    assert measured == pytest.approx(np.hypot(noise, 10.0 / 4096 / np.sqrt(12)), rel=0.15)


def test_seeds_come_one_after_another_over_all_worlds(tmp_path: Path) -> None:
    seeds = [job.world.seed for job in jobs(read_study(small_study(tmp_path)))]
    assert all(a <= b for a, b in pairwise(seeds))


BAD = {
    "unknown key": ("seeds = 2", "speeds = 2", ["speeds", "is no key"]),
    "no phantoms": ('phantoms = ["checkerboard"]', "", ["phantoms", "is missing"]),
    "unknown phantom": ('"checkerboard"', '"chess"', ["phantoms", "'chess'", "usaf_bars"]),
    "unknown estimator": ('"tracker"', '"kalman"', ["estimators", "'kalman'", "there are"]),
    "unknown device": ('"imaging"', '"nothing"', ["'nothing'", "there are"]),
    "device without a field": ('"imaging"', '"chen2020"', ["[scan]"]),
    "pixels that are no number": ("[100]", "[5.5]", ["pixels", "whole number"]),
    "negative p": ("p = [0.5, 1.0]", "p = [-1.0]", ["p:", "greater than 0"]),
    "no drive": ("[6540.0, 30.0, 30.0]", "[6540.0]", ["designs.drive_y", "frequency, amplitude, offset"]),
    "drifts that are no list": ("[0.0, -0.001]", "0.5", ["drifts", "list of numbers"]),
    "empty list": ("drifts = [0.0, -0.001]", "drifts = []", ["drifts", "is empty"]),
    "recording's unknown key": ("duration", "length", ["recording.length"]),
    "no TOML": ("name =", "name", ["is not TOML"]),
    "estimators that are no list": ('["constant", "tracker"]', '"tracker"', ["estimators", "list of names"]),
}


@pytest.mark.parametrize("what", BAD)
def test_bad_studies_get_one_line(what: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    old, new, words = BAD[what]
    path = small_study(tmp_path, old, new)
    assert main(["blur-study", str(path), "-o", str(tmp_path / "out")]) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    for word in ["study.toml", *words]:
        assert word in told, told
    assert not (tmp_path / "out").exists()


def test_the_example_is_a_study() -> None:
    study = read_study(ROOT / "examples" / "study.toml")
    assert sum(len(list(job.cells())) for job in jobs(study)) == 192


def test_a_broken_journal_is_not_guessed_at(tmp_path: Path) -> None:
    from recon.study.run import run_study

    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "cells.jsonl").write_text('{"cell": {}}\nnot json\n')
    with pytest.raises(BadInput, match="line 2 is no record"):
        run_study(small_study(tmp_path), tmp_path / "out")


def test_an_interrupt_tells_what_is_kept(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "recon", "blur-study", str(small_study(tmp_path)), "-o", str(tmp_path / "out")]
    process = subprocess.Popen([*command, "--workers", "1"], stderr=subprocess.PIPE, text=True, cwd=ROOT)
    lines = tmp_path / "out" / "cells.jsonl"
    until(lambda: lines.exists() and lines.stat().st_size > 0)
    process.send_signal(signal.SIGINT)
    told = process.communicate(timeout=300)[1]
    assert process.returncode == 1
    assert "interrupted; what was done is kept" in told
    assert "Traceback" not in told
