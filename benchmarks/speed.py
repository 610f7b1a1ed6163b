"""`make bench`: how fast the parts are, each as a ratio to a named alternative in the same run.

Writes benchmarks/results.json; `speed.py filters mapping` measures these again and keeps the rest. These machines are
noisy: every figure is the best of several repeats, in processor time but for the whole command.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import MappingProxyType

os.environ.setdefault("NUMBA_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numba
import numpy as np
from scipy.stats import binned_statistic_2d

from benchmarks.process import timed
from benchmarks.tracker_bound import device_with, figures
from estimation.filters import prepare, run_compiled
from estimation.reference import absolute
from estimation.reference_filters import run_reference
from estimation.tracker import track
from estimation.tracker.angle import SlowAngle, SlowMotion
from phantoms.experiment import Experiment, run
from phantoms.forward import Plan, simulate
from phantoms.waveforms import Sine
from recon.mapping import Grid, accumulate, pixel_index
from recon.slow_mapping import accumulate_slow
from scanner import devices
from scanner.channel import checked_channel
from scanner.device import Amdm
from scanner.recording import Recording

RESULTS = Path(__file__).with_name("results.json")
REFERENCE_STEPS = 1500
DRIVES = {"x": Sine(27680.0, 30.0, 30.0), "y": Sine(6540.0, 30.0, 30.0)}


def best(function: Callable[[], object], repeats: int = 5) -> float:
    """Shortest time of several calls, after one that compiles [s]; the processor's own, whatever else it has to do."""
    function()
    times = []
    for _ in range(repeats):
        began = time.process_time()
        function()
        times.append(time.process_time() - began)
    return min(times)


def filters() -> dict[str, float]:
    """Compiled against filterpy: the papers' state [theta, theta'], and chen2020's two low-pass sections beside it."""
    device = devices.load("chen2020-driven")
    readout = device.axis("x").require_readout()
    assert isinstance(readout, Amdm)
    bare = replace(device, axes={"x": replace(device.axis("x"), readout=replace(readout, lpf_hz=()))})
    heights = np.array([1e14])
    results = {}
    for state, world in (("", bare), (".with_sections", device)):
        recording, _ = simulate(world, Plan({"x": Sine(31400.0, 30.0, 30.0)}, 0.06))
        problem = prepare(recording, world)[0]
        for name in ("ekf", "ukf"):
            compiled = (problem.signal.size - 1) / best(partial(run_compiled, problem, name, heights))
            reference = best(partial(run_reference, problem, name, heights, REFERENCE_STEPS), 3)
            slow = (REFERENCE_STEPS - 1) / reference
            results |= {f"{name}{state}.steps_per_s": compiled, f"{name}{state}.ratio_filterpy": compiled / slow}
    return results


def steady(frequency: float, phase: float, size: int) -> SlowAngle:
    """A steady motion of 0.185 rad with the small odd harmonics that a parametric drive adds."""
    time = np.linspace(0.0, size / 5e6, 1000)
    still, lines = np.zeros(time.size), np.tile([-1j, 1e-3, 1e-5j], (time.size, 1))
    reference = absolute(frequency, time[0], time[-1])
    slow = SlowMotion(reference, time, still + phase, still, still + np.log(0.185), still, lines)
    return SlowAngle(slow, 5e6, 0.0, size)


def mapping() -> dict[str, float]:
    """A second of samples to 400 x 400, from the slow motion and from angles, against numpy's and scipy's ways.

    np.bincount with indexing and binned_statistic_2d are given the angles; the slow motion makes its own. Intensities
    are the 16-bit integers that converters record; ``float`` says what others cost.
    """
    size = 5_000_000
    slow_x, slow_y = steady(13840.0, 0.0, size), steady(3270.0, 1.0, size)
    x, y = slow_x.values, slow_y.values
    intensity = np.random.default_rng(0).integers(0, 1 << 14, size, np.int16)
    values = intensity.astype(np.float32)
    grid = Grid(400, 400, 0.18, 0.18)

    def bincount() -> np.ndarray:
        column, row = pixel_index(x, 0.18, 400), pixel_index(y, 0.18, 400)
        inside = (column >= 0) & (row >= 0)
        index = row[inside] * 400 + column[inside]
        counts = np.bincount(index, minlength=160_000)
        np.bincount(index, intensity[inside], minlength=160_000)
        return counts

    counts = bincount().reshape(400, 400)
    for own in (accumulate(x, y, intensity, grid)[1], accumulate_slow(slow_x, slow_y, 0, intensity, grid)[1]):
        if not np.array_equal(counts, own):
            raise AssertionError("np.bincount counts otherwise")
    column, row = pixel_index(x, 0.18, 400), pixel_index(y, 0.18, 400)
    index = np.where((column >= 0) & (row >= 0), row * 400 + column, 0).astype(np.int32)
    cells = np.zeros(160_000, np.int64)
    edges = np.linspace(-0.18, 0.18, 401)
    seconds = {
        "samples": best(lambda: accumulate(x, y, intensity, grid)),
        "slow_samples": best(lambda: accumulate_slow(slow_x, slow_y, 0, intensity, grid), 15),
        "slow_float_samples": best(lambda: accumulate_slow(slow_x, slow_y, 0, values, grid), 15),
        "scatter_samples": best(lambda: scatter(index, intensity, cells), 15),
        "bincount": best(bincount, 3),
        "binned": best(lambda: binned_statistic_2d(y, x, intensity, "sum", [edges, edges]), 3),
    }
    return {
        **{f"mapping.{key}_per_s": size / spent for key, spent in seconds.items() if key.endswith("samples")},
        "mapping.ratio_bincount": seconds["bincount"] / seconds["samples"],
        "mapping.ratio_binned_statistic_2d": seconds["binned"] / seconds["samples"],
        "mapping.slow_ratio_bincount": seconds["bincount"] / seconds["slow_samples"],
        "mapping.slow_ratio_binned_statistic_2d": seconds["binned"] / seconds["slow_samples"],
    }


@numba.njit
def scatter(index, values, cells):  # type: ignore[no-untyped-def]
    """The least that any mapping has to do: add values whose pixels are known, sum and count at once."""
    for i in range(index.size):
        cells[np.uint32(index[i])] += (np.int64(values[i]) << np.int64(24)) + np.int64(1)


def tracker() -> dict[str, float]:
    """Tracker over a second: axis by axis, each on an electrode of its own; both on one; the machine's memory.

    Signals are the 16-bit integers that converters record; ``float`` says what others cost.
    """
    separate = device_with(shared=False)
    simulated, _ = simulate(separate, Plan(DRIVES, 1.0))
    alone = [replace(separate, axes={name: separate.axis(name)}, scan=None) for name in DRIVES]
    size = 2 * simulated["sense_x"].size
    own, floats = (
        sum(best(partial(track, recording, device)) for device in alone)
        for recording in (digitised(simulated), simulated)
    )
    shared, _ = simulate(devices.load("imaging"), Plan(DRIVES, 1.0))
    both = best(partial(track, digitised(shared), shared.device))
    block = np.ones(50_000_000)
    return {
        "tracker.samples_per_s": size / own,
        "tracker.float_samples_per_s": size / floats,
        "tracker.shared_samples_per_s": shared["sense"].size / both,
        "memory.read_gb_per_s": block.nbytes / best(block.sum) / 1e9,
    }


def digitised(recording: Recording) -> Recording:
    """The recording as a 16-bit converter stores it, each channel over its own range."""
    channels = {}
    for name, channel in recording.channels.items():
        values = channel.read()
        step = float(np.abs(values).max()) / 32767
        stored = np.round(values / step).astype(np.int16)
        channels[name] = checked_channel(
            name, stored, unit=channel.unit, sample_rate=channel.sample_rate, start=channel.start, gain=step
        )
    return replace(recording, channels=MappingProxyType(channels))


def tracker_bound() -> dict[str, float]:
    """Tracker against the posterior Cramer-Rao bound and the UKF: benchmarks/tracker_bound.py, over a few paths."""
    return figures(4)


def pipeline() -> dict[str, float]:
    """The whole command on the demo's recording, in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        scan = Path(folder) / "scan.h5"
        recording, truth = run(Experiment(), seed=1)
        recording.write(scan, truth)
        runs = [timed("reconstruct", str(scan), "-o", f"{folder}/out") for _ in range(4)]  # the first compiles
    wall = min(run["seconds"] for run in runs[1:])
    return {
        "reconstruct.seconds": wall,
        "reconstruct.realtime_factor": 0.06 / wall,
        "reconstruct.peak_memory_mb": runs[-1]["peak_mb"],
    }


def main() -> None:
    parts = {part.__name__: part for part in (pipeline, filters, mapping, tracker, tracker_bound)}
    wanted = sys.argv[1:] or list(parts)
    results: dict[str, float] = {} if wanted == list(parts) else json.loads(RESULTS.read_text())
    for name in wanted:
        print(f"{name} ...", file=sys.stderr)
        results |= parts[name]()
    RESULTS.write_text(json.dumps({key: float(f"{value:.4g}") for key, value in results.items()}, indent=1) + "\n")
    for key, value in results.items():
        print(f"{key:36} {value:14.4g}")


if __name__ == "__main__":
    main()
