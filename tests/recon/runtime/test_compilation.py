"""The first run says that it compiles; later runs do not."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

CODE = """
import numba
from recon.runtime.compilation import announce_compilation

announce_compilation()

@numba.njit(cache=True)
def twice(x):
    return 2 * x

@numba.njit
def thrice(x):
    return 3 * x

assert (twice(1), thrice(1)) == (2, 3)
"""

LAWS_CODE = """
from recon.runtime.compilation import announce_compilation

announce_compilation()

from estimation.candidate_terms.discrepancy import DISCREPANCY_TERMS
from scanner.integrator.runge_kutta import in_all_lanes
from scanner.terms import catalogue

laws = [law for term in [*catalogue().values(), *DISCREPANCY_TERMS.values()] for law in (term.torque, term.capacitance)]
compiled = [in_all_lanes(law) for law in laws if law]
assert len(compiled) > 10
"""


def _messages_of_two_runs(script: Path, code: str, **environment: str) -> list[str]:
    script.write_text(code, encoding="utf-8")
    whole = os.environ | {"PYTHONPATH": str(Path(__file__).parents[3])} | environment
    options: dict[str, Any] = {"env": whole, "capture_output": True, "text": True, "check": True}
    return [subprocess.run([sys.executable, str(script)], **options).stderr for _ in range(2)]


def test_compilation_is_announced_once(tmp_path: Path) -> None:
    messages = _messages_of_two_runs(tmp_path / "script.py", CODE, NUMBA_CACHE_DIR=str(tmp_path / "cache"))
    assert messages == ["compiling, once (one to three minutes)\n", ""]


def test_the_count_of_functions_leaves_the_line_empty(tmp_path: Path) -> None:
    """What is printed next, as an error, begins a line of its own."""
    on_a_terminal = "import sys\nsys.stderr.isatty = lambda: True\n" + CODE
    shown, _ = _messages_of_two_runs(tmp_path / "script.py", on_a_terminal, NUMBA_CACHE_DIR=str(tmp_path / "cache"))
    counted, erased = shown.splitlines()[-2:]  # a carriage return is read as the end of a line
    assert counted == "functions: 1"
    assert erased == " " * len(counted)


def test_no_law_is_compiled_in_a_second_run(tmp_path: Path) -> None:
    _, second = _messages_of_two_runs(tmp_path / "script.py", LAWS_CODE)
    assert second == ""
