"""The notebooks are their scripts, and what they say when they are run is true."""

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

EXAMPLES = Path(__file__).parent.parent / "examples"
NOTEBOOKS = sorted(EXAMPLES.glob("[0-9]_*.ipynb"))


def numbers(pattern: str, told: str) -> list[float]:
    """What a pattern's one group finds; at least one."""
    found = [float(each) for each in re.findall(pattern, told)]
    assert found, told
    return found


def reconstructed(told: str) -> None:
    assert max(numbers(r"error (\d+\.\d+)° rms", told)) < 0.2
    code = [cell for cell in cells("1_first_reconstruction") if cell["cell_type"] == "code"]
    assert len("".join("".join(cell["source"]) for cell in code).splitlines()) < 30


def bounded(told: str) -> None:
    assert numbers(r"= (\d\.\d+) rad", told) == [0.01]
    exact, at_bound, beyond = numbers(r"(\d\.\d+) at ", told)
    assert exact < at_bound < 3.0 * exact
    assert beyond > 3.0 * at_bound


def identified(told: str) -> None:
    nominal, found, true = numbers(r"(\d+\.\d+) Hz", told)
    assert abs(found - true) < 0.02 * abs(nominal - true)


def estimated(told: str) -> None:
    by = dict(re.findall(r"x (\w+) +phase error (\d+\.\d+)°", told))
    assert list(by) == ["constant", "ekf", "ukf", "tracker"]
    assert float(by["tracker"]) < 0.05 < 0.286 < float(by["constant"])


def designed(told: str) -> None:
    assert min(numbers(r"(\d+\.\d+) pictures", told)) >= 60.0
    worst, best = (numbers(pattern, told)[0] for pattern in (r"fill (\d+\.\d+)%", r"to (\d+\.\d+)%"))
    assert worst < best
    assert best >= 85.0


def found_missing(told: str) -> None:
    before, after = (numbers(r"(\d+\.\d+)° in", line) for line in re.findall(r" device: (.*)", told))
    assert max(before) > 3.0
    assert max(after) < 0.1
    assert re.search(r"^(readout-lag|  or readout-lag)", told, re.MULTILINE)


CLAIMS: dict[str, Callable[[str], None]] = {
    "1_first_reconstruction": reconstructed,
    "2_bound_and_blur": bounded,
    "3_ringdown_to_device": identified,
    "4_estimators": estimated,
    "5_designing_a_scan": designed,
    "6_missing_physics": found_missing,
}


def cells(name: str) -> list[dict]:
    return json.loads((EXAMPLES / f"{name}.ipynb").read_text(encoding="utf-8"))["cells"]


def test_there_is_a_notebook_for_every_script_and_it_is_the_script(tmp_path: Path) -> None:
    scripts = sorted(EXAMPLES.glob("[0-9]_*.py"))
    assert [path.stem for path in scripts] == [path.stem for path in NOTEBOOKS] == list(CLAIMS)
    copies = [shutil.copy(path, tmp_path) for path in scripts]
    make = "import sys; from sphinx_gallery.notebook import python_to_jupyter_cli as make; make(sys.argv[1:])"
    subprocess.run([sys.executable, "-c", make, *copies], check=True, capture_output=True)
    for path in NOTEBOOKS:
        made = json.loads((tmp_path / path.name).read_text(encoding="utf-8"))["cells"]
        assert cells(path.stem) == made, "run make notebooks"


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
