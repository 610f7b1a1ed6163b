"""Notebooks equal their scripts, and what they print is true."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parent.parent.parent / "examples"
NOTEBOOKS = sorted(EXAMPLES.glob("[0-9]_*.ipynb"))


def numbers(pattern: str, output: str) -> list[float]:
    """Numbers that the one group of a pattern matches; fails where there is none."""
    values = [float(text) for text in re.findall(pattern, output)]
    assert values, output
    return values


def check_first_reconstruction(output: str) -> None:
    assert max(numbers(r"error (\d+\.\d+)° rms", output)) < 0.2
    code = [cell for cell in cells("1_first_reconstruction") if cell["cell_type"] == "code"]
    assert len("".join("".join(cell["source"]) for cell in code).splitlines()) < 30


def check_bound(output: str) -> None:
    assert numbers(r"= (\d\.\d+) rad", output) == [0.01]
    exact, at_bound, beyond = numbers(r"(\d\.\d+) at ", output)
    assert exact < at_bound < 3.0 * exact
    assert beyond > 3.0 * at_bound


def check_identification(output: str) -> None:
    nominal, found, true = numbers(r"(\d+\.\d+) Hz", output)
    assert abs(found - true) < 0.02 * abs(nominal - true)


def check_estimators(output: str) -> None:
    by = dict(re.findall(r"x (\w+) +phase error (\d+\.\d+)°", output))
    assert list(by) == ["constant", "ekf", "ukf", "tracker"]
    assert float(by["tracker"]) < 0.05 < 0.286 < float(by["constant"])


def check_design(output: str) -> None:
    assert min(numbers(r"(\d+\.\d+) pictures", output)) >= 60.0
    worst, best = (numbers(pattern, output)[0] for pattern in (r"fill (\d+\.\d+)%", r"to (\d+\.\d+)%"))
    assert worst < best
    assert best >= 85.0


def check_missing_physics(output: str) -> None:
    before, after = (numbers(r"(\d+\.\d+)° in", line) for line in re.findall(r" device: (.*)", output))
    assert max(before) > 3.0
    assert max(after) < 0.1
    assert re.search(r"^(readout-lag|  or readout-lag)", output, re.MULTILINE)


def check_own_arrays(output: str) -> None:
    assert numbers(r"x: (\d+\.\d+) Hz", output) == [pytest.approx(2003.0, abs=0.1)]
    assert numbers(r"y: .* amplitude (\d\.\d+) rad", output) == [pytest.approx(0.08, rel=0.01)]
    assert "intensity: 300000 samples" in output


CLAIMS: dict[str, Callable[[str], None]] = {
    "1_first_reconstruction": check_first_reconstruction,
    "2_bound_and_blur": check_bound,
    "3_ringdown_to_device": check_identification,
    "4_estimators": check_estimators,
    "5_designing_a_scan": check_design,
    "6_missing_physics": check_missing_physics,
    "7_your_own_arrays": check_own_arrays,
}


def cells(name: str) -> list[dict]:
    return json.loads((EXAMPLES / f"{name}.ipynb").read_text(encoding="utf-8"))["cells"]


@pytest.mark.slow
def test_there_is_a_notebook_for_every_script_and_it_is_the_script(tmp_path: Path) -> None:
    scripts = sorted(EXAMPLES.glob("[0-9]_*.py"))
    assert [path.stem for path in scripts] == [path.stem for path in NOTEBOOKS] == list(CLAIMS)
    copies = [shutil.copy(path, tmp_path) for path in scripts]
    make = "import sys; from sphinx_gallery.notebook import python_to_jupyter_cli as make; make(sys.argv[1:])"
    subprocess.run([sys.executable, "-c", make, *copies], check=True, capture_output=True)
    for path in NOTEBOOKS:
        made = json.loads((tmp_path / path.name).read_text(encoding="utf-8"))["cells"]
        assert cells(path.stem) == made, "run make notebooks"


@pytest.mark.slow
@pytest.mark.parametrize("name", CLAIMS)
def test_a_notebook_runs_and_says_what_is_true(name: str) -> None:
    code = "\n".join("".join(cell["source"]) for cell in cells(name) if cell["cell_type"] == "code")
    environment = os.environ | {"MPLBACKEND": "Agg", "PYTHONIOENCODING": "utf-8"}
    done = subprocess.run(
        [sys.executable, "-c", code.replace("%matplotlib", "# %matplotlib")],
        cwd=EXAMPLES, env=environment, capture_output=True, encoding="utf-8",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    CLAIMS[name](done.stdout)
