"""The Python example of the README runs, and the README names the make targets."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.simulated import imaging

ROOT = Path(__file__).parent.parent.parent


@pytest.mark.slow
def test_the_python_example_of_the_readme_runs(tmp_path: Path) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    recording, truth = imaging()
    recording.write(tmp_path / "scan.h5", truth)
    process = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert "(400, 400)" in process.stdout


def test_the_readme_names_the_make_targets() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    targets = re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    for command in ("demo", "test"):
        assert f"make {command}" in text
        assert command in targets
