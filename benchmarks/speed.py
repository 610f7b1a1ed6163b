"""`make bench`: speed of the parts of the program, also as ratios to a named alternative in the same run.

Writes benchmarks/results.json. `speed.py filters mapping` measures these two again and leaves the other results
unchanged. Each time is the shortest of several repeats, because other processes disturb the measurement. Times are
processor times, except for the whole command.
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

from benchmarks.process import time_command
from benchmarks.tracker_bound import noise_free_device, summarise_benchmark
from estimation.filters.filterpy_engine import run_filterpy
from estimation.filters.inputs import prepare_filter_inputs
from estimation.filters.run import run_compiled
from estimation.reference import absolute_reference
from estimation.tracker import track
from estimation.tracker.angle_synthesis import PhasorAngle, PhasorMotion
from phantoms.experiment import Experiment, simulate_experiment
from phantoms.forward import Plan, simulate
from phantoms.waveforms import Sine
from recon.imaging.gridding import accumulate_samples, pixel_index
from recon.imaging.phasor_gridding import accumulate_phasors
from recon.imaging.picture import Grid
from scanner import devices
from scanner.channel import make_channel
from scanner.recording import Recording
from scanner.stages import Amdm

RESULTS = Path(__file__).with_name("results.json")

FILTERPY_STEPS = 1500
"""Samples that filterpy filters: 0.3 ms of a recording, 0.07 to 0.2 s of run time."""

ACCELERATION_VARIANCES = np.array([1e14])
"""Process noise of the filters [(rad/s^2)^2], near the tuned value; it does not change the run time."""

DRIVES = {"x": Sine(27680.0, 30.0, 30.0), "y": Sine(6540.0, 30.0, 30.0)}
"""The demo's drives, near twice the resonances [V]."""

SAMPLE_RATE_HZ = 5e6

HALF_ANGLE_RAD, WIDTH_PX = 0.18, 400
"""Half the field [rad] and width [pixels] of the picture, those of the demo."""

PIXELS = WIDTH_PX * WIDTH_PX

SCAN_S = 0.06
"""Length of the demo's recording [s]."""

BOUND_DRIFTS = 4
"""Drifts over which ``tracker_bound`` averages: some ten seconds."""


def shortest_time(function: Callable[[], object], repeats: int = 5) -> float:
    """Shortest processor time of several calls [s], after a first call that compiles."""
    function()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        function()
        times.append(time.process_time() - start)
    return min(times)


def measure_filters() -> dict[str, float]:
    """Steps per second of the compiled filters, and their ratio to filterpy.

    Two states: theta and theta', as in the papers; and ``with_sections`` those of chen2020's two low-pass sections too.
    """
    device = devices.load("chen2020-driven")
    readout = device.axis("x").require_readout()
    assert isinstance(readout, Amdm)
    without_sections = replace(device, axes={"x": replace(device.axis("x"), readout=replace(readout, lpf_hz=()))})
    results = {}
    for suffix, simulated in (("", without_sections), (".with_sections", device)):
        recording, _ = simulate(simulated, Plan({"x": Sine(31400.0, 30.0, 30.0)}, 0.06))
        inputs = prepare_filter_inputs(recording, simulated)[0]
        for name in ("ekf", "ukf"):
            compiled = (inputs.signal.size - 1) / shortest_time(
                partial(run_compiled, inputs, name, ACCELERATION_VARIANCES)
            )
            filterpy_s = shortest_time(partial(run_filterpy, inputs, name, ACCELERATION_VARIANCES, FILTERPY_STEPS), 3)
            filterpy = (FILTERPY_STEPS - 1) / filterpy_s
            results |= {f"{name}{suffix}.steps_per_s": compiled, f"{name}{suffix}.ratio_filterpy": compiled / filterpy}
    return results


def make_steady_angle(frequency: float, phase: float, size: int) -> PhasorAngle:
    """A steady motion of 0.185 rad with the small odd harmonics that a parametric drive adds."""
    time = np.linspace(0.0, size / SAMPLE_RATE_HZ, 1000)
    zeros, harmonics = np.zeros(time.size), np.tile([-1j, 1e-3, 1e-5j], (time.size, 1))
    reference = absolute_reference(frequency, time[0], time[-1])
    motion = PhasorMotion(reference, time, zeros + phase, zeros, zeros + np.log(0.185), zeros, harmonics)
    return PhasorAngle(motion, SAMPLE_RATE_HZ, 0.0, size)


def measure_mapping() -> dict[str, float]:
    """Samples per second that are gridded to 400 x 400 pixels, and the ratios to numpy and scipy.

    ``samples`` are gridded from their angles, ``slow_samples`` from phase and amplitude, of which the angles are
    computed. np.bincount with indexing and binned_statistic_2d get the angles. Intensities are 16-bit integers as
    converters record them, except for ``slow_float_samples``. ``scatter_samples`` is an upper bound of any method.

    Raises:
        AssertionError: the counts differ from those of np.bincount.
    """
    size = 5_000_000
    slow_x, slow_y = make_steady_angle(13840.0, 0.0, size), make_steady_angle(3270.0, 1.0, size)
    x, y = slow_x.read(), slow_y.read()
    intensity = np.random.default_rng(0).integers(0, 1 << 14, size, np.int16)
    values = intensity.astype(np.float32)
    grid = Grid(WIDTH_PX, WIDTH_PX, HALF_ANGLE_RAD, HALF_ANGLE_RAD)

    def bincount() -> np.ndarray:
        column, row = (pixel_index(angle, HALF_ANGLE_RAD, WIDTH_PX) for angle in (x, y))
        inside = (column >= 0) & (row >= 0)
        index = row[inside] * WIDTH_PX + column[inside]
        counts = np.bincount(index, minlength=PIXELS)
        np.bincount(index, intensity[inside], minlength=PIXELS)
        return counts

    expected = bincount().reshape(WIDTH_PX, WIDTH_PX)
    for counts in (
        accumulate_samples(x, y, intensity, grid)[1],
        accumulate_phasors(slow_x, slow_y, 0, intensity, grid)[1],
    ):
        if not np.array_equal(counts, expected):
            raise AssertionError("the counts differ from those of np.bincount")
    column, row = (pixel_index(angle, HALF_ANGLE_RAD, WIDTH_PX) for angle in (x, y))
    index = np.where((column >= 0) & (row >= 0), row * WIDTH_PX + column, 0).astype(np.int32)
    cells = np.zeros(PIXELS, np.int64)
    edges = np.linspace(-HALF_ANGLE_RAD, HALF_ANGLE_RAD, WIDTH_PX + 1)
    seconds = {
        "samples": shortest_time(lambda: accumulate_samples(x, y, intensity, grid)),
        "slow_samples": shortest_time(lambda: accumulate_phasors(slow_x, slow_y, 0, intensity, grid), 15),
        "slow_float_samples": shortest_time(lambda: accumulate_phasors(slow_x, slow_y, 0, values, grid), 15),
        "scatter_samples": shortest_time(lambda: scatter_samples(index, intensity, cells), 15),
        "bincount": shortest_time(bincount, 3),
        "binned": shortest_time(lambda: binned_statistic_2d(y, x, intensity, "sum", [edges, edges]), 3),
    }
    return {
        **{f"mapping.{key}_per_s": size / time_s for key, time_s in seconds.items() if key.endswith("samples")},
        "mapping.ratio_bincount": seconds["bincount"] / seconds["samples"],
        "mapping.ratio_binned_statistic_2d": seconds["binned"] / seconds["samples"],
        "mapping.slow_ratio_bincount": seconds["bincount"] / seconds["slow_samples"],
        "mapping.slow_ratio_binned_statistic_2d": seconds["binned"] / seconds["slow_samples"],
    }


@numba.njit
def scatter_samples(index, values, cells):  # type: ignore[no-untyped-def]
    """Add values whose pixels are known, sum and count in one word: the least that any gridding has to do."""
    for i in range(index.size):
        cells[np.uint32(index[i])] += (np.int64(values[i]) << np.int64(24)) + np.int64(1)


def measure_tracker() -> dict[str, float]:
    """Samples per second of the tracker over 1 s of two axes, on separate electrodes and on a shared one.

    Signals are 16-bit integers as converters record them, except for ``float_samples``. The rate at which the machine
    reads memory is measured for comparison.
    """
    separate = noise_free_device(shared=False)
    simulated, _ = simulate(separate, Plan(DRIVES, 1.0))
    single_axes = [replace(separate, axes={name: separate.axis(name)}, scan=None) for name in DRIVES]
    size = 2 * simulated["sense_x"].size
    integer_s, float_s = (
        sum(shortest_time(partial(track, recording, device)) for device in single_axes)
        for recording in (digitise_recording(simulated), simulated)
    )
    shared, _ = simulate(devices.load("imaging"), Plan(DRIVES, 1.0))
    shared_s = shortest_time(partial(track, digitise_recording(shared), shared.device))
    array = np.ones(50_000_000)
    return {
        "tracker.samples_per_s": size / integer_s,
        "tracker.float_samples_per_s": size / float_s,
        "tracker.shared_samples_per_s": shared["sense"].size / shared_s,
        "memory.read_gb_per_s": array.nbytes / shortest_time(array.sum) / 1e9,
    }


def digitise_recording(recording: Recording) -> Recording:
    """The recording as a 16-bit converter stores it, whose range is that of each channel's samples."""
    channels = {}
    for name, channel in recording.channels.items():
        values = channel.read()
        step = float(np.abs(values).max()) / 32767
        stored = np.round(values / step).astype(np.int16)
        channels[name] = make_channel(
            name, stored, unit=channel.unit, sample_rate=channel.sample_rate, start=channel.start, gain=step
        )
    return replace(recording, channels=MappingProxyType(channels))


def measure_tracker_bound() -> dict[str, float]:
    """``benchmarks.tracker_bound`` over a few drifts."""
    return summarise_benchmark(BOUND_DRIFTS)


def measure_pipeline() -> dict[str, float]:
    """Run time and peak memory of the command ``reconstruct`` on the demo's recording, in a separate process."""
    with tempfile.TemporaryDirectory() as folder:
        scan = Path(folder) / "scan.h5"
        recording, truth = simulate_experiment(Experiment(), seed=1)
        recording.write(scan, truth)
        runs = [
            time_command("reconstruct", str(scan), "-o", f"{folder}/out") for _ in range(4)
        ]  # the first run compiles
    wall_s = min(run["seconds"] for run in runs[1:])
    return {
        "reconstruct.seconds": wall_s,
        "reconstruct.realtime_factor": SCAN_S / wall_s,
        "reconstruct.peak_memory_mb": runs[-1]["peak_mb"],
    }


PARTS: dict[str, Callable[[], dict[str, float]]] = {
    "pipeline": measure_pipeline,
    "filters": measure_filters,
    "mapping": measure_mapping,
    "tracker": measure_tracker,
    "tracker_bound": measure_tracker_bound,
}
"""Parts of the benchmark by their names on the command line."""


def main() -> None:
    selected = sys.argv[1:] or list(PARTS)
    results: dict[str, float] = {} if selected == list(PARTS) else json.loads(RESULTS.read_text())
    for name in selected:
        print(f"{name} ...", file=sys.stderr)
        results |= PARTS[name]()
    RESULTS.write_text(json.dumps({key: float(f"{value:.4g}") for key, value in results.items()}, indent=1) + "\n")
    for key, value in results.items():
        print(f"{key:36} {value:14.4g}")


if __name__ == "__main__":
    main()
