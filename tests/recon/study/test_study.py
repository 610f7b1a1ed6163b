"""Blur studies: every cell is computed once, and its numbers equal those of a single reconstruction."""

import csv
import fcntl
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation.estimators import estimators
from recon.cli import main
from recon.evaluation import truth_from_simulation
from recon.pipeline import reconstruct
from recon.report.summary import summarise
from recon.steps.reconstruction import Options
from recon.study import report as study_report
from recon.study.job import run_job, sense_rms, simulate_scenario
from recon.study.plan import Study, StudyDesign, cell_key, plan_jobs, read_study, remaining_jobs
from recon.study.table import AXIS_COLUMNS, table_columns, table_rows
from scanner.device import Device
from scanner.errors import BadInput
from tests.support.study import CELLS, assert_study_is_complete, read_journal, small_study, wait_until

ROOT = Path(__file__).parent.parent.parent.parent

SLOW_AXIS = """
[{name}]
mechanics = {{J = 1e-10, b = {b}, k = 1.42122e-5}}
drive = {{kind = "linear", torque_per_volt = 5.685e-9}}
readout = {{kind = "position", gain = 20.0, noise_sd = 0.0}}
"""
"""An axis of 60 Hz with a position sensor."""


@pytest.fixture(scope="module")
def finished_study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The output folder of the small study, computed by one worker."""
    folder = tmp_path_factory.mktemp("study")
    assert main(["blur-study", str(small_study(folder)), "-o", str(folder / "out"), "--workers", "1", "--parquet"]) == 0
    return folder / "out"


@pytest.mark.slow
def test_a_study_writes_table_summary_and_report(finished_study: Path) -> None:
    assert {path.name for path in finished_study.iterdir()} == {
        "cells.jsonl", "table.csv", "table.parquet", "summary.json", "report.html", "study.toml",
    }  # fmt: skip
    assert_study_is_complete(finished_study)
    summary = json.loads((finished_study / "summary.json").read_text())
    assert summary["conclusion"].startswith("Use ")
    assert (summary["cells"], summary["computed"], summary["failed"]) == (CELLS, CELLS, 0)
    assert (
        summary["estimators"]["tracker"]["phase_rmse_deg_median"]
        < summary["estimators"]["constant"]["phase_rmse_deg_p95"]
    )
    page = (finished_study / "report.html").read_text()
    assert page.count('src="data:image/svg') == 3
    assert "://" not in page.replace("http://www.w3.org", "")


@pytest.mark.slow
def test_the_parquet_table_of_an_earlier_run_does_not_stay_beside_a_newer_table(
    finished_study: Path, tmp_path: Path
) -> None:
    shutil.copytree(finished_study, tmp_path / "out")
    study = str(small_study(tmp_path))
    assert main(["blur-study", study, "-o", str(tmp_path / "out"), "--workers", "1"]) == 0
    assert not (tmp_path / "out" / "table.parquet").exists()


@pytest.mark.slow
def test_parquet_and_csv_have_the_same_content(finished_study: Path) -> None:
    from pyarrow import parquet

    table = parquet.read_table(finished_study / "table.parquet").to_pylist()
    with (finished_study / "table.csv").open() as file:
        for row, text in zip(table, csv.DictReader(file), strict=True):
            assert {name: "" if value is None else str(value) for name, value in row.items()} == {
                name: str(float(value)) if isinstance(row[name], float) else value for name, value in text.items()
            }


def test_a_cell_has_the_numbers_of_a_single_reconstruction(finished_study: Path) -> None:
    record = next(
        record
        for record in read_journal(finished_study)
        if record["cell"]["estimator"] == "tracker" and record["cell"]["p"] == 0.5
    )
    scenario = next(
        job.scenario
        for job in plan_jobs(read_study(finished_study / "study.toml"))
        if (job.scenario.drift, job.scenario.seed) == (record["cell"]["drift"], record["cell"]["seed"])
    )
    recording, truth = simulate_scenario(scenario)
    options = Options(estimator="tracker", pixels=(100, 100), p=0.5)
    result = reconstruct(recording, options, truth_from_simulation(truth), quiet=True)
    summary = summarise(result)
    for axis in "xy":
        assert record[axis]["phase_rmse_deg"] == pytest.approx(summary[axis]["phase_rmse_deg"], rel=1e-9)
        assert record[axis]["bound_deg"] == pytest.approx(np.degrees(0.5 / 50))
        assert record[axis]["within_bound"] == summary[axis]["within_bound"]
        assert record[axis]["blur_total_px"] == pytest.approx(summary[axis]["blur_px"]["total"], rel=1e-9)
    assert record["picture_error"] == pytest.approx(summary["picture"]["rms"], rel=1e-9)
    assert record["fill"] == summary["fill"]


def test_finished_cells_are_not_recomputed(finished_study: Path, capsys: pytest.CaptureFixture) -> None:
    before = (finished_study / "cells.jsonl").read_bytes()
    assert main(["blur-study", str(finished_study / "study.toml"), "-o", str(finished_study), "--json"]) == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out)["computed"] == 0
    assert captured.err == ""
    assert (finished_study / "cells.jsonl").read_bytes() == before


def test_only_missing_cells_of_a_changed_study_remain(finished_study: Path, tmp_path: Path) -> None:
    finished = {cell_key(record["cell"]): record for record in read_journal(finished_study)}

    def remaining(old: str, new: str) -> int:
        return sum(
            len(list(job.cells()))
            for job in remaining_jobs(plan_jobs(read_study(small_study(tmp_path, old, new))), finished)
        )

    assert remaining("", "") == 0
    assert remaining("seeds = 2", "seeds = 3") == CELLS // 2
    assert remaining("drifts = [0.0, -0.001]", "drifts = [-0.001]") == 0
    assert remaining("pixels = [100]", "pixels = [100, 60]") == CELLS
    assert remaining("27680.0", "27690.0") == CELLS  # another drive under the same name
    assert remaining("duration = 0.004", "duration = 0.005") == CELLS


@pytest.mark.slow
def test_of_a_truncated_journal_at_most_the_last_cell_is_recomputed(finished_study: Path, tmp_path: Path) -> None:
    text = (finished_study / "cells.jsonl").read_bytes()
    (tmp_path / "cut").mkdir()
    (tmp_path / "cut" / "cells.jsonl").write_bytes(text[: len(text) * 7 // 8])
    complete = text[: len(text) * 7 // 8].count(b"\n")
    assert main(["blur-study", str(finished_study / "study.toml"), "-o", str(tmp_path / "cut"), "--workers", "1"]) == 0
    summary = json.loads((tmp_path / "cut" / "summary.json").read_text())
    assert CELLS - complete <= summary["computed"] <= CELLS - complete + 1
    resumed, uninterrupted = (
        {cell_key(each["cell"]): each | {"seconds": 0} for each in read_journal(folder)}
        for folder in (tmp_path / "cut", finished_study)
    )
    assert resumed == uninterrupted


@pytest.mark.slow
def test_a_killed_study_keeps_its_finished_cells_and_its_workers_exit(tmp_path: Path) -> None:
    study = small_study(tmp_path)
    command = [sys.executable, "-m", "recon", "blur-study", str(study), "-o", str(tmp_path / "out"), "--workers", "2"]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL, start_new_session=True, cwd=ROOT)
    lines = tmp_path / "out" / "cells.jsonl"
    wait_until(lambda: lines.exists() and lines.stat().st_size > 0)
    process.kill()
    process.wait()
    before = lines.read_bytes()
    assert before
    wait_until(lambda: not process_group_exists(process.pid))
    assert not (tmp_path / "out" / "summary.json").exists()
    assert main(["blur-study", str(study), "-o", str(tmp_path / "out"), "--workers", "1"]) == 0
    assert_study_is_complete(tmp_path / "out")
    assert lines.read_bytes().startswith(before[: before.rfind(b"\n") + 1])


def process_group_exists(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


def test_a_second_run_in_the_same_folder_is_refused(finished_study: Path, capsys: pytest.CaptureFixture) -> None:
    with (finished_study / "cells.jsonl").open("ab") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        assert main(["blur-study", str(finished_study / "study.toml"), "-o", str(finished_study)]) == 2
    assert "another run" in capsys.readouterr().err


def test_a_study_of_which_no_cell_was_computed_is_not_done(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    path = small_study(tmp_path, "27680.0, 30.0, 30.0", "27680.0, 3.0, 3.0")
    assert main(["blur-study", str(path), "-o", str(tmp_path / "out"), "--workers", "1"]) == 2
    assert "does not sustain a motion" in capsys.readouterr().out


def test_a_failed_reconstruction_is_a_record_of_the_study(tmp_path: Path) -> None:
    # The drive does not sustain a motion, so every variant fails.
    study = read_study(small_study(tmp_path, "27680.0, 30.0, 30.0", "27680.0, 3.0, 3.0"))
    records = run_job(next(iter(plan_jobs(study))))
    assert len(records) == 4
    assert all("does not sustain" in each["failed"] for each in records)
    data = table_columns(table_rows(records))
    assert np.isnan(data["phase_rmse_deg"]).all()


@pytest.mark.parametrize("quality", [20.0, 200.0])
def test_the_rms_of_a_slow_axis_is_that_of_its_settled_motion(quality: float) -> None:
    mechanics = {"J": 1e-10, "k": 1.42122e-5, "b": 1e-10 * 2.0 * np.pi * 60.0 / quality}
    drive = (60.0, 10.0, 0.0)
    text = "".join(SLOW_AXIS.format(name=name, b=mechanics["b"]) for name in "xy")
    rate = 2.0 * np.pi * drive[0]
    stiffness = abs(mechanics["k"] - mechanics["J"] * rate**2 + 1j * rate * mechanics["b"])
    amplitude_v = 20.0 * 5.685e-9 * drive[1] / stiffness
    rms = sense_rms(StudyDesign("slow", text, drive, drive), 2e4)
    assert rms == pytest.approx(dict.fromkeys(("sense_x", "sense_y"), amplitude_v / np.sqrt(2.0)), rel=0.03)


@settings(max_examples=5)
@given(st.floats(-10.0, 40.0))
def test_noise_has_the_requested_signal_to_noise_ratio(snr_db: float) -> None:
    with tempfile.TemporaryDirectory() as folder:
        scenario = next(iter(plan_jobs(read_study(small_study(Path(folder)))))).scenario
    clean = sense_rms(scenario.design, scenario.recording.sample_rate)["sense"]
    recording, _ = simulate_scenario(replace(scenario, snr_db=snr_db))
    noise = Device.from_toml(recording.device_toml).readout.noise_sd
    assert 20 * np.log10(clean / noise) == pytest.approx(snr_db)
    # The sixth difference suppresses the smooth motion and leaves the noise.
    measured = np.std(np.diff(recording["sense"].read(), 6)) / np.sqrt(924)
    assert measured == pytest.approx(np.hypot(noise, 10.0 / 4096 / np.sqrt(12)), rel=0.15)


def test_all_jobs_of_a_seed_precede_those_of_the_next_seed(tmp_path: Path) -> None:
    seeds = [job.scenario.seed for job in plan_jobs(read_study(small_study(tmp_path)))]
    assert all(a <= b for a, b in pairwise(seeds))


BAD_STUDIES = {
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
    "a drift that no stiffness has": ("-0.001]", "-1.5]", ["drift: is -1.5", "above -1"]),
    "too few samples": ("1e6", "1e4", ["too few for x, of a resonance of"]),
    "too many samples": ("duration = 0.004", "duration = 1e5", ["1e+11 samples"]),
    "a spot wider than the field": ("[recording]", "[recording]\nspot_um = 200.0", ["too wide for a field"]),
    "too many photons": ("[recording]", "[recording]\nphotons = 1e30", ["photons_per_sample is 1e+30"]),
    "a picture that no memory holds": ("[100]", "[50000]", ["a picture of 50000x50000 pixels"]),
    "estimators that are no list": ('["constant", "tracker"]', '"tracker"', ["estimators", "list of names"]),
}


@pytest.mark.parametrize("what", BAD_STUDIES)
def test_bad_studies_are_refused_in_one_line(what: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    old, new, words = BAD_STUDIES[what]
    path = small_study(tmp_path, old, new)
    assert main(["blur-study", str(path), "-o", str(tmp_path / "out")]) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    for word in ["study.toml", *words]:
        assert word in message, message
    assert not (tmp_path / "out").exists()


def test_the_example_study_is_valid() -> None:
    study = read_study(ROOT / "examples" / "study.toml")
    assert sum(len(list(job.cells())) for job in plan_jobs(study)) == 192


def test_a_broken_journal_is_refused(tmp_path: Path) -> None:
    from recon.study.run import run_study

    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "cells.jsonl").write_text('{"cell": {}}\nnot json\n')
    with pytest.raises(BadInput, match="line 2 is no record"):
        run_study(small_study(tmp_path), tmp_path / "out")


@pytest.mark.slow
def test_an_interrupt_message_states_that_results_are_kept(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "recon", "blur-study", str(small_study(tmp_path)), "-o", str(tmp_path / "out")]
    process = subprocess.Popen([*command, "--workers", "1"], stderr=subprocess.PIPE, text=True, cwd=ROOT)
    lines = tmp_path / "out" / "cells.jsonl"
    wait_until(lambda: lines.exists() and lines.stat().st_size > 0)
    process.send_signal(signal.SIGINT)
    message = process.communicate(timeout=300)[1]
    assert process.returncode == 1
    assert "interrupted; finished jobs are kept" in message
    assert "Traceback" not in message


def test_figures_show_every_estimator_in_a_style_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    drawings: list[Any] = []
    monkeypatch.setattr(study_report, "figure_uri", lambda drawing: drawings.append(drawing) or "")
    design = StudyDesign("d", "", (1, 1, 1), (1, 1, 1))
    study = Study("s", (design,), ("checkerboard",), tuple(estimators()))
    cell = {"phantom": "checkerboard", "design": "d", "drift": 0.0, "snr_db": None, "pixels": 400, "p": 1.0, "seed": 0}
    of_cell = {"picture_error": 0.1, "fill": 1.0, "seconds": 1.0}
    records = [
        {"cell": cell | {"estimator": name}} | of_cell | {axis: dict.fromkeys(AXIS_COLUMNS, 0.1 * k) for axis in "xy"}
        for k, name in enumerate(study.estimators, 1)
    ]
    rows = table_rows(records)
    for figure in (study_report._error_figure, study_report._blur_figure):
        figure(study, table_columns(rows))
    for drawing in drawings:
        lines = [line for line in drawing.axes[0].lines if line.get_label() in study.estimators]
        assert [line.get_label() for line in lines] == list(study.estimators)
        assert len({(line.get_color(), line.get_fillstyle()) for line in lines}) == len(lines)
