"""What the README and the examples show runs as it stands there."""

import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
from worlds import imaging

ROOT = Path(__file__).parent.parent


def test_first_picture(capsys: pytest.CaptureFixture) -> None:
    runpy.run_path(str(ROOT / "examples" / "first_picture.py"), run_name="__main__")
    told = capsys.readouterr().out
    errors = [float(value) for value in re.findall(r"error (\d+\.\d+)° rms", told)]
    assert len(errors) == 2
    assert max(errors) < 0.2
    assert len((ROOT / "examples" / "first_picture.py").read_text(encoding="utf-8").splitlines()) < 30


def test_readme_python(tmp_path: Path) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    recording, truth = imaging()
    recording.write(tmp_path / "scan.h5", truth)
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert "(400, 400)" in done.stdout


def test_readme_names_both_commands() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    targets = re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    for command in ("demo", "test"):
        assert f"make {command}" in text
        assert command in targets
