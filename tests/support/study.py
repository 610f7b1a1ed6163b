"""A study small enough to run in tests, and checks of what it leaves on disk."""

import csv
import json
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from recon.study.plan import cell_key
from recon.study.table import COLUMN_NAMES

TEXT = """
name = "small"
phantoms = ["checkerboard"]
estimators = ["constant", "tracker"]
drifts = [0.0, -0.001]
pixels = [100]
p = [0.5, 1.0]
seeds = 2

[recording]
duration = 0.004
sample_rate = 1e6

[[designs]]
name = "papers"
device = "imaging"
drive_x = [27680.0, 30.0, 30.0]
drive_y = [6540.0, 30.0, 30.0]
"""
CELLS = 16


def small_study(folder: Path, old: str = "", new: str = "") -> Path:
    """The study's file, with a change."""
    assert old in TEXT
    path = folder / "study.toml"
    path.write_text(TEXT.replace(old, new) if old else TEXT)
    return path


def read_journal(folder: Path) -> list[dict]:
    """The records of a study's journal, one for every finished cell."""
    return [json.loads(line) for line in (folder / "cells.jsonl").read_text().splitlines()]


def assert_study_is_complete(folder: Path) -> None:
    """Every cell of the small study is once in the journal and once per axis in the table."""
    cells = Counter(cell_key(record["cell"]) for record in read_journal(folder))
    assert len(cells) == CELLS
    assert set(cells.values()) == {1}
    with (folder / "table.csv").open() as file:
        table = list(csv.DictReader(file))
    assert len(table) == 2 * CELLS
    assert len({tuple(row[name] for name in (*COLUMN_NAMES[:8], "axis")) for row in table}) == 2 * CELLS


def wait_until(condition: Callable[[], bool], timeout_s: float = 300.0) -> None:
    """Return as soon as ``condition()`` is true; fail after ``timeout_s``."""
    end = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)
