"""A study small enough to run in tests."""

from pathlib import Path

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
