"""`make bench`: how fast the parts are, each as a ratio to a named alternative in the same run.

Writes benchmarks/results.json. These machines are noisy: every figure is the best of several repeats, and a ratio's two
sides are measured in turn.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("NUMBA_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from scipy.stats import binned_statistic_2d

from estimation.filters import prepare, run_compiled
from estimation.reference_filters import run_reference
from estimation.tracker import track
from phantoms.experiment import Experiment, run
from phantoms.forward import Plan, simulate
from phantoms.waveforms import Sine
from recon.mapping import Grid, accumulate, pixel_index
from recon.slow_mapping import accumulate_slow
from scanner import devices

RESULTS = Path(__file__).with_name("results.json")
REFERENCE_STEPS = 1500
DRIVES = {"x": Sine(27680.0, 30.0, 30.0), "y": Sine(6540.0, 30.0, 30.0)}


def best(function: Callable[[], object], repeats: int = 5) -> float:
    """Shortest time of several calls, after one that compiles [s]."""
    function()
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        function()
        times.append(time.perf_counter() - began)
    return min(times)


def filters() -> dict[str, float]:
    """Compiled against filterpy, one axis of chen2020's scanner behind its two low-pass sections (4 states)."""
    plan = Plan({"x": Sine(31400.0, 30.0, 30.0)}, 0.06)
    recording, _ = simulate(devices.load("chen2020-driven"), plan)
    problem = prepare(recording, recording.device)[0]
    heights = np.array([1e14])
    results = {}
    for name in ("ekf", "ukf"):
        compiled = (problem.signal.size - 1) / best(lambda name=name: run_compiled(problem, name, heights))
        slow = (REFERENCE_STEPS - 1) / best(lambda name=name: run_reference(problem, name, heights, REFERENCE_STEPS), 3)
        results |= {f"{name}.steps_per_s": compiled, f"{name}.ratio_filterpy": compiled / slow}
    return results


def mapping() -> dict[str, float]:
    """A second of samples to 400 x 400, against np.bincount with indexing and scipy's binned_statistic_2d."""
    t = np.arange(5_000_000) / 5e6
    x, y = 0.185 * np.sin(2 * np.pi * 13840 * t), 0.185 * np.sin(2 * np.pi * 3270 * t + 1.0)
    intensity = np.random.default_rng(0).random(t.size)
    grid = Grid(400, 400, 0.18, 0.18)
    own = best(lambda: accumulate(x, y, intensity, grid))

    def bincount() -> np.ndarray:
        column, row = pixel_index(x, 0.18, 400), pixel_index(y, 0.18, 400)
        inside = (column >= 0) & (row >= 0)
        index = row[inside] * 400 + column[inside]
        counts = np.bincount(index, minlength=160_000)
        np.bincount(index, intensity[inside], minlength=160_000)
        return counts

    edges = np.linspace(-0.18, 0.18, 401)
    counts = accumulate(x, y, intensity, grid)[1]
    if not np.array_equal(bincount().reshape(400, 400), counts):
        raise AssertionError("np.bincount counts otherwise")
    binned = best(lambda: binned_statistic_2d(y, x, intensity, "sum", [edges, edges]), 1)
    return {
        "mapping.samples_per_s": t.size / own,
        "mapping.ratio_bincount": best(bincount, 3) / own,
        "mapping.ratio_binned_statistic_2d": binned / own,
    }


def tracker() -> dict[str, float]:
    """Tracker over two axes on one electrode, a second of it; mapping from its slow motion; the machine's memory."""
    recording, _ = simulate(devices.load("imaging"), Plan(DRIVES, 1.0))
    motion = track(recording, recording.device)
    size = recording["sense"].size
    seconds = best(lambda: track(recording, recording.device), 2)
    x, y = (motion.axes[axis].angle for axis in "xy")
    intensity = np.random.default_rng(0).random(size).astype(np.float32)
    grid = Grid(400, 400, 0.18, 0.18)
    block = np.ones(50_000_000)
    return {
        "tracker.samples_per_s": size / seconds,
        "mapping.slow_samples_per_s": size / best(lambda: accumulate_slow(x, y, 0, intensity, grid)),
        "memory.read_gb_per_s": block.nbytes / best(block.sum) / 1e9,
    }


def pipeline() -> dict[str, float]:
    """The whole command on the demo's recording, in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        scan = Path(folder) / "scan.h5"
        recording, truth = run(Experiment(), seed=1)
        recording.write(scan, truth)
        command = [sys.executable, "-m", "recon", "reconstruct", str(scan), "-o", f"{folder}/out"]
        wall = best(lambda: subprocess.run(command, check=True, capture_output=True), 3)
        peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    return {"reconstruct.seconds": wall, "reconstruct.realtime_factor": 0.06 / wall, "reconstruct.peak_memory_mb": peak}


def main() -> None:
    results: dict[str, float] = {}
    # The pipeline first: the peak memory of a child counts what its parent held when it was forked.
    for part in (pipeline, filters, mapping, tracker):
        print(f"{part.__name__} ...", file=sys.stderr)
        results |= part()
    RESULTS.write_text(json.dumps({key: float(f"{value:.4g}") for key, value in results.items()}, indent=1) + "\n")
    for key, value in results.items():
        print(f"{key:36} {value:14.4g}")


if __name__ == "__main__":
    main()
