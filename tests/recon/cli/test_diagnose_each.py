"""``lissajous diagnose --each``: table and page of many recordings; what is done is kept, what is bad is listed."""

import base64
import csv
import json
import re
from pathlib import Path

import pytest

from recon.cli import main
from recon.cli.diagnose_each import COLUMNS, diagnose_each
from recon.report.fleet import fleet_report
from recon.runtime.fleet import plan_fleet, state_inputs

FINDING = {
    "axis": "x",
    "stage": "mechanics",
    "effect": "cubic-stiffness",
    "probability": 0.98,
    "share": 0.7,
    "parameters": [{"name": "k3", "value": -1.1e-5, "ci95": [-1.15e-5, -1.05e-5], "unit": "N m/rad^3"}],
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three recordings, of which an earlier run has diagnosed two; the third is no recording."""
    recordings = tmp_path / "recordings"
    recordings.mkdir()
    for name in ("a", "b", "c"):
        (recordings / f"{name}.h5").write_text("no recording", encoding="utf-8")
    paths = [recordings / "a.h5", recordings / "b.h5"]
    fleet = plan_fleet(paths, tmp_path / "out", state_inputs(None, None), "diagnosis.json", False)
    for path, findings in zip(paths, ([FINDING], []), strict=True):
        place = fleet.folders[path]
        place.mkdir()
        content = {"verdict": "mismatch" if findings else "consistent", "findings": findings}
        (place / "diagnosis.json").write_text(json.dumps(content), encoding="utf-8")
        (place / "device.toml").write_text('name = "mirror"\n', encoding="utf-8")
    return tmp_path


@pytest.mark.slow
def test_table_and_page_list_every_device(folder: Path, capsys: pytest.CaptureFixture) -> None:
    arguments = ["diagnose", "--each", str(folder / "recordings"), "-o", str(folder / "out"), "--workers", "1"]
    assert main(arguments) == 2
    out = capsys.readouterr().out
    assert "1 of 2 recordings shows effects" in out
    assert "c.h5: is not an HDF5 file" in out
    with (folder / "out" / "table.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == COLUMNS
    assert [row["recording"] for row in rows] == ["a.h5", "b.h5", "c.h5"]
    assert rows[0]["effect"] == "cubic-stiffness"
    assert float(rows[0]["ci95_high"]) == -1.05e-5
    assert [row["verdict"] for row in rows] == ["mismatch", "consistent", ""]
    page = (folder / "out" / "report.html").read_text(encoding="utf-8")
    assert "cubic-stiffness" in page
    assert "data:image/svg+xml" in page


def test_results_of_another_device_are_not_mixed_in(folder: Path, capsys: pytest.CaptureFixture) -> None:
    arguments = ["diagnose", "--each", str(folder / "recordings"), "-o", str(folder / "out"), "--device", "imaging"]
    assert main(arguments) == 2
    assert "other options" in capsys.readouterr().err


def test_completed_recordings_are_kept(folder: Path) -> None:
    (folder / "recordings" / "c.h5").unlink()
    before = (folder / "out" / "a" / "diagnosis.json").stat().st_mtime_ns
    summary = diagnose_each([folder / "recordings"], folder / "out")
    assert summary["kept"] == summary["recordings"] == 2
    assert summary["exit"] == 0
    assert (folder / "out" / "a" / "diagnosis.json").stat().st_mtime_ns == before


def test_recordings_of_one_name_in_two_folders_are_two(tmp_path: Path) -> None:
    paths = [tmp_path / place / "r.h5" for place in ("p", "q")]
    for path in paths:
        path.parent.mkdir()
        path.write_text("no recording", encoding="utf-8")
    summary = diagnose_each(paths, tmp_path / "out", None, None, workers=1)
    assert [row["recording"] for row in summary["table"]] == [str(path) for path in paths]


def test_workers_without_each_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert main(["diagnose", str(tmp_path / "a.h5"), "-o", str(tmp_path / "out"), "--workers", "2"]) == 2
    assert "--workers: has no effect without --each" in capsys.readouterr().err


def test_names_of_recordings_are_drawn_as_they_are() -> None:
    size = {"parameter": "k3", "value": 2.0, "ci95_low": 1.0, "ci95_high": 3.0, "unit": "N m/rad^3"}
    row = {**FINDING, **size}
    rows = [{**row, "recording": name, "device": "d", "verdict": "mismatch"} for name in ("a$_$b.h5", "5$ ^2$.h5")]
    page = fleet_report({"table": rows, "failed": 0, "recordings": 2, "seconds": 1.0})
    (figure,) = re.findall('data:image/svg\\+xml;base64,([^"]+)', page)
    labels = re.findall("<!-- (.*?) -->", base64.b64decode(figure).decode())
    assert {"a$_$b", "5$ ^2$"} <= set(labels)
