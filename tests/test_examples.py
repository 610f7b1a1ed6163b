"""What the README shows runs as it stands there."""

import re
import subprocess
import sys
from pathlib import Path

from worlds import imaging

ROOT = Path(__file__).parent.parent


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
