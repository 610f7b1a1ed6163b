"""Compiled functions on disk that may be outdated."""

import os
from pathlib import Path

import pytest

from scanner.compiled_code import remove_outdated

STORED = ("scanner/terms/__pycache__/law.nbi", "estimation/__pycache__/fit.nbi", "recon/__pycache__/grid.nbi")
SOURCES = ("scanner/laws.py", "estimation/fit.py", "recon/grid.py")


@pytest.mark.parametrize(("changed", "kept"), [(None, 3), (SOURCES[0], 0), (SOURCES[1], 1), (SOURCES[2], 2)])
def test_functions_that_may_contain_changed_code_are_removed(tmp_path: Path, changed: str | None, kept: int) -> None:
    for name, seconds in [*((name, 2e9) for name in STORED), *((name, 1e9) for name in SOURCES)]:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("import numba")
        os.utime(tmp_path / name, (seconds, seconds))
    (tmp_path / "scanner/plain.py").write_text("newer, with no compiled function")
    os.utime(tmp_path / "scanner/plain.py", (3e9, 3e9))
    if changed:
        os.utime(tmp_path / changed, (3e9, 3e9))
    remove_outdated(tmp_path)
    assert [name for name in STORED if (tmp_path / name).exists()] == list(STORED[:kept])
