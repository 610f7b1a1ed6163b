"""`make wheel-check`: install the wheel into an empty environment of every Python, simulate and reconstruct.

    python benchmarks/wheel.py [PYTHON...]

A PYTHON is a command or a path. Without any, python3.11 to python3.13 of the path and of pyenv are used.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parent.parent
VERSIONS = ("3.11", "3.12", "3.13")
WRITTEN = {"image.tif", "coverage.tif", "motion.h5", "summary.json", "report.html", "image.png"}


def call(*command: str | Path, cwd: Path) -> str:
    """The output of a command that runs without this environment's variables. A failure ends the check."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "VIRTUAL_ENV"))}
    process = subprocess.run([str(part) for part in command], cwd=cwd, env=environment, capture_output=True, text=True)
    if process.returncode:
        sys.exit(f"{' '.join(map(str, command))}: exit code {process.returncode}\n{process.stdout}{process.stderr}")
    return process.stdout


def pythons() -> list[str]:
    """An interpreter of each version that is installed."""
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    interpreters = []
    for version in VERSIONS:
        candidates = [*sorted(pyenv.glob(f"{version}.*/bin/python{version}")), shutil.which(f"python{version}")]
        interpreters += [str(path) for path in candidates if path][:1]
    return interpreters


def check(python: str, wheel: Path, folder: Path) -> str:
    """One line on one Python: versions, and the times of installation and of the first picture."""
    start = time.perf_counter()
    call(python, "-m", "venv", folder / "env", cwd=folder)
    programs = folder / "env" / "bin"
    call(programs / "python", "-m", "pip", "install", "--quiet", wheel, cwd=folder)
    installed = time.perf_counter() - start
    call(programs / "python", "-m", "pip", "check", cwd=folder)
    call(programs / "lissajous", "simulate", "-o", "scan.h5", "--duration", "0.01", cwd=folder)
    summary = json.loads(call(programs / "reconstruct-from-recording", "scan.h5", "-o", "out", "--json", cwd=folder))
    missing = WRITTEN - {path.name for path in (folder / "out").iterdir()}
    if missing or not max(summary["phase_rmse_deg"].values()) < 0.1:
        sys.exit(f"{python}: {missing or summary['phase_rmse_deg']}")
    version = call(programs / "python", "--version", cwd=folder).strip()
    libraries = "import numpy, numba, h5py; print('numpy', numpy.__version__, 'numba', numba.__version__)"
    error = ", ".join(f"{value:.4f}° {axis}" for axis, value in summary["phase_rmse_deg"].items())
    return (
        f"{version}, {call(programs / 'python', '-c', libraries, cwd=folder).strip()}: phase error {error}; "
        f"{installed:.0f} s to install, {time.perf_counter() - start - installed:.0f} s to the picture"
    )


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        call(sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", folder, ROOT, cwd=folder)
        (wheel,) = folder.glob("*.whl")
        print(f"{wheel.name}: {wheel.stat().st_size / 1e3:.0f} kB", flush=True)
        for python in sys.argv[1:] or pythons():
            environment = Path(tempfile.mkdtemp(dir=folder))
            print(check(python, wheel, environment), flush=True)


if __name__ == "__main__":
    main()
