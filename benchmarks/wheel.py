"""`make wheel-check`: the wheel, installed into an empty environment of every Python, simulates and reconstructs.

    python benchmarks/wheel.py [PYTHON...]

A PYTHON is a command or a path; without any, python3.11 to python3.13 are looked for on the path and among pyenv's.
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
    """Run a command without what this environment could lend it; returns its output, stops the check on failure."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "VIRTUAL_ENV"))}
    done = subprocess.run([str(each) for each in command], cwd=cwd, env=environment, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"{' '.join(map(str, command))}: exit code {done.returncode}\n{done.stdout}{done.stderr}")
    return done.stdout


def pythons() -> list[str]:
    """A Python of each version, as far as there is one."""
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    found = []
    for version in VERSIONS:
        own = [*sorted(pyenv.glob(f"{version}.*/bin/python{version}")), shutil.which(f"python{version}")]
        found += [str(each) for each in own if each][:1]
    return found


def check(python: str, wheel: Path, folder: Path) -> str:
    """One line on one Python: versions, and the time from nothing to a picture."""
    began = time.perf_counter()
    call(python, "-m", "venv", folder / "env", cwd=folder)
    own = folder / "env" / "bin"
    call(own / "python", "-m", "pip", "install", "--quiet", wheel, cwd=folder)
    installed = time.perf_counter() - began
    call(own / "python", "-m", "pip", "check", cwd=folder)
    call(own / "lissajous", "simulate", "-o", "scan.h5", "--duration", "0.01", cwd=folder)
    summary = json.loads(call(own / "reconstruct-from-recording", "scan.h5", "-o", "out", "--json", cwd=folder))
    missing = WRITTEN - {path.name for path in (folder / "out").iterdir()}
    if missing or not max(summary["phase_rmse_deg"].values()) < 0.1:
        sys.exit(f"{python}: {missing or summary['phase_rmse_deg']}")
    version = call(own / "python", "--version", cwd=folder).strip()
    libraries = "import numpy, numba, h5py; print('numpy', numpy.__version__, 'numba', numba.__version__)"
    error = ", ".join(f"{value:.4f}° {axis}" for axis, value in summary["phase_rmse_deg"].items())
    return (
        f"{version}, {call(own / 'python', '-c', libraries, cwd=folder).strip()}: phase error {error}; "
        f"{installed:.0f} s to install, {time.perf_counter() - began - installed:.0f} s to the picture"
    )


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        call(sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", folder, ROOT, cwd=folder)
        (wheel,) = folder.glob("*.whl")
        print(f"{wheel.name}: {wheel.stat().st_size / 1e3:.0f} kB", flush=True)
        for python in sys.argv[1:] or pythons():
            own = Path(tempfile.mkdtemp(dir=folder))
            print(check(python, wheel, own), flush=True)


if __name__ == "__main__":
    main()
