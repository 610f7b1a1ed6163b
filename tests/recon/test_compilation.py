"""The first run says that it compiles; later runs do not."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

CODE = """
import numba
from recon.compilation import announce_compilation

announce_compilation()

@numba.njit(cache=True)
def twice(x):
    return 2 * x

@numba.njit
def thrice(x):
    return 3 * x

assert (twice(1), thrice(1)) == (2, 3)
"""


def test_compilation_is_announced_once(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(CODE, encoding="utf-8")
    root = Path(__file__).parent.parent.parent
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": str(root)}
    options: dict[str, Any] = {"env": environment, "capture_output": True, "text": True, "check": True}
    messages = [subprocess.run([sys.executable, str(script)], **options).stderr for _ in range(2)]
    assert messages == ["compiling, once (about a minute)\n", ""]
