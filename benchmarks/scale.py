"""Costs of a reconstruction by the length of the recording, by the pixels of the picture and by the number of axes.

python -m benchmarks.scale [disk|disk_long|disk_sensors|live|length|pixels|axes|longest ...]

A scan without drift repeats every second, so that one simulated period makes a recording of any length. Its noise
repeats too, but no more than ten times in 10 s: noise that repeats each 0.1 s is a pattern which the check for a moving
sample examines at length. Each case runs in a separate process, whose peak memory is measured.
"""

from __future__ import annotations

import json
import multiprocessing
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from benchmarks.process import read_peak_memory_mb, time_command
from benchmarks.speed import digitise_recording
from benchmarks.tracker_bound import SEPARATE_READOUT_OFFSET_V
from estimation.tracker import track
from phantoms.experiment import Experiment, simulate_experiment
from recon.imaging.intensity_gridding import grid_intensity
from recon.imaging.picture import Grid
from recon.steps.reconstruction import Options
from scanner.channel import make_channel
from scanner.device import Device
from scanner.recording import Recording
from scanner.stages import Amdm

SAMPLE_RATE_HZ = 5e6

START_S = 0.1
"""Time that is left out before the period: the motion is steady after it."""

PERIOD_S = 1.0
"""Time after which the scan repeats: it has whole cycles of 13840 and of 3270 Hz."""

PERIOD_SAMPLES = round(PERIOD_S * SAMPLE_RATE_HZ)

LENGTHS_SAMPLES = (1_000_000, 10_000_000, 100_000_000)
"""Lengths of ``measure_lengths``: 0.2, 2 and 20 s."""

LONGEST_SAMPLES = 1_000_000_000
"""Length of ``measure_longest``: 200 s."""

COMPARISON_SAMPLES = 20_000_000
"""Length at which pictures and axes are compared: 4 s, so that the costs of the start are small."""

PICTURE_WIDTHS_PX = (100, 400, 1600)
"""Widths of the square pictures: 1600 squared does not fit in a second-level cache."""

HALF_ANGLE_RAD = 0.18
"""Half the field of the pictures, that of the imaging scanner."""

LIVE_PICTURES = (("mean", 400), ("mean", 256), ("kernel", 256))
"""Kind and width of the live pictures."""

LIVE_S, FRAME_S, WRITE_INTERVAL_S = 6.0, 0.1, 0.01
"""Lengths of the live recording and of a frame (the period of the scan), and interval between two writes [s]."""

RESULTS = Path(__file__).with_name("scale.json")
Results = dict[str, float]


@dataclass(frozen=True)
class RepeatedSamples:
    """The samples of one period, repeated. Slicing copies them; that is all that a ``Channel`` requires.

    Attributes:
        period: samples, shape (PERIOD_SAMPLES,).
        size: number of samples after repetition.
    """

    period: NDArray[np.int16]
    size: int

    @property
    def shape(self) -> tuple[int]:
        return (self.size,)

    @property
    def dtype(self) -> np.dtype[Any]:
        return self.period.dtype

    ndim = 1

    def __getitem__(self, rows: slice) -> NDArray[np.int16]:
        first, stop, _ = rows.indices(self.size)
        offset = first % PERIOD_SAMPLES
        return np.tile(self.period, (offset + stop - first) // PERIOD_SAMPLES + 1)[offset : offset + stop - first]


def simulate_period(device: Device | None = None) -> Recording:
    """A period of the demo's scan in its steady motion; with another device if one is given."""
    experiment = Experiment(duration=START_S + PERIOD_S, drift={})
    recording, _ = simulate_experiment(experiment if device is None else replace(experiment, device=device), seed=1)
    return recording.slice(START_S, START_S + PERIOD_S)


def simulate_sensors() -> Recording:
    """A period of the demo's scan with two angle channels in place of drives and sense signal."""
    recording, truth = simulate_experiment(Experiment(duration=START_S + PERIOD_S, drift={}), seed=1)
    channels = {"intensity": recording["intensity"]}
    for name in ("angle_x", "angle_y"):
        values, _ = truth[name]  # type: ignore[misc]
        channels[name] = make_channel(name, values, unit="rad", sample_rate=SAMPLE_RATE_HZ)
    return replace(recording, channels=MappingProxyType(channels)).slice(START_S, START_S + PERIOD_S)


def with_separate_readouts(device: Device) -> Device:
    """The device with a readout for each axis."""
    assert isinstance(device.readout, Amdm)
    readout = replace(device.readout, b_cir=SEPARATE_READOUT_OFFSET_V)
    return replace(device, axes={n: replace(a, readout=readout) for n, a in device.axes.items()}, readout=None)


def repeat_period(period: Recording, size: int, axes: str = "xy") -> Recording:
    """A recording of ``size`` samples of the repeated scan, int16, which takes no memory.

    Args:
        period: one period of the scan.
        size: number of samples.
        axes: whose channels it has; the intensity is included.
    """
    channels = {
        name: replace(channel, raw=RepeatedSamples(channel.stored(), size), first=0, stop=size, start=0.0)
        for name, channel in digitise_recording(period).channels.items()
        if name.rpartition("_")[2] in (*axes, name)
    }
    return Recording(MappingProxyType(channels), period.attrs, None, period.device_toml)


def measure_costs(path: Path, size: int, axes: str = "xy", width: int = 400) -> Results:
    """Processor seconds of each step with one thread, and the process's peak memory [MB].

    Args:
        path: file of one period of the scan.
        size: number of samples.
        axes: that are tracked; two are mapped too.
        width: of the picture [pixels].
    """
    grid = Grid(width, width, HALF_ANGLE_RAD, HALF_ANGLE_RAD)
    results: Results = {}
    with Recording.open(path) as period:
        for samples in (PERIOD_SAMPLES, size):  # the first run compiles
            recording = repeat_period(period, samples, axes)
            assert recording.device is not None
            device = replace(recording.device, axes={name: recording.device.axes[name] for name in axes})
            start = time.process_time()
            motion = track(recording, device)
            results["track_s"] = time.process_time() - start
            if axes == "xy":
                start = time.process_time()
                grid_intensity(motion, recording["intensity"], grid, [])
                results["map_s"] = time.process_time() - start
    return results | {"peak_mb": read_peak_memory_mb()}


def run_in_process(prefix: str, function: Callable[..., Results], *arguments: Any) -> Results:
    """Results of a function in a separate process, their keys with ``prefix`` and a dot in front."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return add_prefix(prefix, pool.submit(function, *arguments).result())


def add_prefix(prefix: str, results: Results) -> Results:
    """The results, their keys with ``prefix`` and a dot in front."""
    return {f"{prefix}.{key}": value for key, value in results.items()}


def measure_lengths(folder: Path) -> Results:
    """Costs by the length of the recording, LENGTHS_SAMPLES."""
    period, results = write_period(simulate_period(), folder), Results()
    for size in LENGTHS_SAMPLES:
        results |= run_in_process(f"length.{size:.0e}", measure_costs, period, size)
    return results


def measure_longest(folder: Path) -> Results:
    """Costs of LONGEST_SAMPLES."""
    period = write_period(simulate_period(), folder)
    return run_in_process(f"length.{LONGEST_SAMPLES:.0e}", measure_costs, period, LONGEST_SAMPLES)


def measure_pixels(folder: Path) -> Results:
    """Costs by the width of the picture, PICTURE_WIDTHS_PX."""
    period, results = write_period(simulate_period(), folder), Results()
    for width in PICTURE_WIDTHS_PX:
        results |= run_in_process(f"pixels.{width}", measure_costs, period, COMPARISON_SAMPLES, "xy", width)
    return results


def measure_axes(folder: Path) -> Results:
    """Costs of either axis and of both, each with a separate readout."""
    period, results = write_period(simulate_period(with_separate_readouts(Experiment().device)), folder), Results()
    for axes in ("x", "y", "xy"):
        results |= run_in_process(f"axes.{axes}", measure_costs, period, COMPARISON_SAMPLES, axes)
    return results


def measure_disk(folder: Path) -> Results:
    """Costs of the command on 10 s of two axes from the disk. A run on 1 s before it compiles."""
    reconstruct_from_disk(simulate_period(), folder, 1.0)
    return add_prefix("disk", reconstruct_from_disk(simulate_period(), folder, 10.0))


def measure_long_disk(folder: Path) -> Results:
    """Costs of the command on 100 s: 4 GB of samples, and 4 GB of angles that the command writes."""
    return add_prefix("disk_long", reconstruct_from_disk(simulate_period(), folder, 100.0))


def measure_sensors(folder: Path) -> Results:
    """Costs of the command on 10 s of two position sensors from the disk. A run on 1 s before it compiles."""
    reconstruct_from_disk(simulate_sensors(), folder, 1.0)
    return add_prefix("disk_sensors", reconstruct_from_disk(simulate_sensors(), folder, 10.0))


def reconstruct_from_disk(period: Recording, folder: Path, seconds: float) -> Results:
    """Costs of the command ``reconstruct`` on a file of ``seconds`` of the scan, whose period is given."""
    path = folder / "recording.h5"
    with Recording.open(write_period(period, folder)) as stored:
        repeat_period(stored, round(seconds * SAMPLE_RATE_HZ)).write(path)
    return time_command("reconstruct", str(path), "-o", str(folder / "out"))


def measure_live(folder: Path) -> Results:
    """Frames and latency while another process writes LIVE_S seconds at the rate of the recording, by LIVE_PICTURES.

    The latency is counted from the writer's flush of a frame's last sample until its image.tif is in place.
    ``cpu_per_frame`` is the processor time of the follower over the number of frames.
    """
    from recon.live.follow import follow_recording

    period_path, results = write_period(simulate_period(), folder), Results()
    with Recording.open(period_path) as period:
        short = folder / "short.h5"
        repeat_period(period, PERIOD_SAMPLES).write(short)
    for kind, width in LIVE_PICTURES:
        options, path = Options(picture=kind, pixels=(width, width)), folder / f"growing-{kind}-{width}.h5"
        follow_recording(short, folder / "warm", options, frame_time=FRAME_S / 2, quiet_time=0.1)  # compiles
        writer = multiprocessing.get_context("spawn").Process(target=record_live, args=(period_path, path))
        writer.start()
        busy = time.process_time()
        summary = follow_recording(path, folder / "out", options, frame_time=FRAME_S, quiet_time=30.0)
        busy = time.process_time() - busy
        writer.join()
        flushed, end = np.load(path.with_suffix(".npy")).T
        late = [shown - flushed[np.searchsorted(end, stop - 1e-9)] for stop, shown in summary.shown]
        name = f"live.{kind}.{width}"
        results |= {f"{name}.frames": summary.frames, f"{name}.dropped": summary.dropped}
        results |= {f"{name}.latency_median_s": float(np.median(late)), f"{name}.latency_max_s": max(late)}
        results |= {f"{name}.cpu_per_frame_s": busy / max(summary.frames, 1)}
    return results


def record_live(period_path: Path, path: Path) -> None:
    """Write LIVE_S seconds of the scan (HDF5, SWMR) in real time, and beside it when each part was flushed."""
    size = round(LIVE_S * SAMPLE_RATE_HZ)
    with Recording.open(period_path) as period, h5py.File(path, "w", libver="latest") as file:
        recording = repeat_period(period, size)
        file.attrs.update({"format": "lissajous-recording", "version": 1})
        file.create_group("device").attrs["toml"] = recording.device_toml
        group = file.create_group("channels")
        for channel in recording.channels.values():
            dataset = group.create_dataset(channel.name, (0,), np.int16, maxshape=(None,), chunks=(1 << 16,))
            dataset.attrs.update({"unit": "V", "sample_rate": SAMPLE_RATE_HZ, "gain": channel.gain})
        file.swmr_mode = True
        start, written, log = time.perf_counter(), 0, []
        while written < size:
            stop = min(round((time.perf_counter() - start) * SAMPLE_RATE_HZ), size)
            for channel in recording.channels.values():
                group[channel.name].resize((stop,))
                group[channel.name][written:stop] = channel.stored(written, stop)
                group[channel.name].flush()
            written = stop
            log.append((time.monotonic(), stop / SAMPLE_RATE_HZ))
            time.sleep(WRITE_INTERVAL_S)
    np.save(path.with_suffix(".npy"), np.array(log))


def write_period(recording: Recording, folder: Path) -> Path:
    """Write one period of the scan into the folder and return its path."""
    path = folder / "period.h5"
    recording.write(path)
    return path


PARTS: dict[str, Callable[[Path], Results]] = {
    "disk": measure_disk,
    "disk_long": measure_long_disk,
    "disk_sensors": measure_sensors,
    "live": measure_live,
    "length": measure_lengths,
    "pixels": measure_pixels,
    "axes": measure_axes,
    "longest": measure_longest,
}
"""Parts of the benchmark by their names on the command line."""


def main(selected: list[str]) -> None:
    results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    for name, measure in PARTS.items():
        if not selected or name in selected:
            print(f"{name} ...", file=sys.stderr)
            with tempfile.TemporaryDirectory() as folder:
                part = measure(Path(folder))
            for key, value in part.items():
                print(f"{key:28} {value:12.4g}")
            results |= {key: float(f"{value:.4g}") for key, value in part.items()}
            RESULTS.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
