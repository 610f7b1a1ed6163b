"""What a reconstruction costs against its length, its pixels and its axes, and 10 s of 5 MS/s from the disk.

python -m benchmarks.scale [disk|disk_long|live|length|pixels|axes|longest ...]

A scan without drift repeats itself every 0.1 s, so one simulated period makes a recording of any length. The same
noise comes back with it, which costs a tracker neither more nor less. Each case runs in a process of its own, whose
peak memory is its own.
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

from benchmarks.process import peak_mb, timed
from benchmarks.speed import digitised
from estimation.tracker import track
from phantoms.experiment import Experiment, run
from recon.mapping import Grid
from recon.pipeline import Options, mapped
from scanner.device import Amdm, Device
from scanner.recording import Recording

RATE = 5e6
PERIOD = 500_000  # samples in which 13840 and 3270 Hz both come round
LENGTHS = (1_000_000, 10_000_000, 100_000_000)
LONGEST = 1_000_000_000
SIZE = 20_000_000  # samples for pixels and axes
PIXELS = (100, 400, 1600)
LIVE_S, FRAME_S, WRITTEN_EVERY = 6.0, 0.1, 0.01
RESULTS = Path(__file__).with_name("scale.json")
Results = dict[str, float]


@dataclass(frozen=True)
class Repeated:
    """One period's samples over and over, made when they are sliced, as a ``Channel`` wants them."""

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
        turn = first % PERIOD
        return np.tile(self.period, (turn + stop - first) // PERIOD + 1)[turn : turn + stop - first]


def one_period(device: Device | None = None) -> Recording:
    """0.1 s of the demo's scan once its motion has settled; by another device if one is given."""
    experiment = Experiment(duration=0.2, drift={})
    simulated, _ = run(experiment if device is None else replace(experiment, device=device), seed=1)
    return simulated.slice(0.1, 0.2)


def separate(device: Device) -> Device:
    """The device with a readout for each axis."""
    assert isinstance(device.readout, Amdm)
    readout = replace(device.readout, b_cir=4.95)  # half the sum of two combs stays within the converter's range
    return replace(device, axes={n: replace(a, readout=readout) for n, a in device.axes.items()}, readout=None)


def repeated(period: Recording, size: int, axes: str = "xy") -> Recording:
    """A recording of ``size`` samples of the same scan, int16, that takes no memory; of some axes only if so said."""
    channels = {
        name: replace(channel, raw=Repeated(channel.stored(), size), first=0, stop=size, start=0.0)
        for name, channel in digitised(period).channels.items()
        if name.rpartition("_")[2] in (*axes, name)
    }
    return Recording(MappingProxyType(channels), period.attrs, None, period.device_toml)


def costs(period: Path, size: int, axes: str = "xy", pixels: int = 400) -> Results:
    """Processor seconds of each step on ``size`` samples, one thread, and the process's peak memory [MB]."""
    grid = Grid(pixels, pixels, 0.18, 0.18)
    done: Results = {}
    with Recording.open(period) as one:
        for samples in (PERIOD, size):  # the first compiles
            recording = repeated(one, samples, axes)
            assert recording.device is not None
            device = replace(recording.device, axes={name: recording.device.axes[name] for name in axes})
            began = time.process_time()
            motion = track(recording, device)
            done["track_s"] = time.process_time() - began
            if axes == "xy":
                began = time.process_time()
                mapped(motion, recording["intensity"], grid, [])
                done["map_s"] = time.process_time() - began
    return done | {"peak_mb": peak_mb()}


def apart(function: Callable[..., Results], *arguments: Any) -> Results:
    """A case in a process of its own."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


def named(prefix: str, results: Results) -> Results:
    return {f"{prefix}.{key}": value for key, value in results.items()}


def length(folder: Path) -> Results:
    period = written(one_period(), folder)
    return {k: v for n in LENGTHS for k, v in named(f"length.{n:.0e}", apart(costs, period, n)).items()}


def longest(folder: Path) -> Results:
    return named(f"length.{LONGEST:.0e}", apart(costs, written(one_period(), folder), LONGEST))


def pixels(folder: Path) -> Results:
    period = written(one_period(), folder)
    return {k: v for n in PIXELS for k, v in named(f"pixels.{n}", apart(costs, period, SIZE, "xy", n)).items()}


def axes(folder: Path) -> Results:
    period = written(one_period(separate(Experiment().device)), folder)
    return {
        k: v for each in ("x", "y", "xy") for k, v in named(f"axes.{each}", apart(costs, period, SIZE, each)).items()
    }


def disk(folder: Path) -> Results:
    """10 s of two axes from the disk by the command itself; a tenth of it before, to compile."""
    from_disk(folder, 1.0)
    return named("disk", from_disk(folder, 10.0))


def disk_long(folder: Path) -> Results:
    """100 s likewise: 4 GB, and as many for the angles that the command leaves."""
    return named("disk_long", from_disk(folder, 100.0))


def from_disk(folder: Path, seconds: float) -> Results:
    path = folder / "recording.h5"
    with Recording.open(written(one_period(), folder)) as period:
        repeated(period, round(seconds * RATE)).write(path)
    return timed("reconstruct", str(path), "-o", str(folder / "out"))


def live(folder: Path) -> Results:
    """LIVE_S seconds followed while another process writes them as fast as they would be recorded."""
    from recon.follow import follow

    period, path = written(one_period(), folder), folder / "growing.h5"
    with Recording.open(period) as one:
        short = folder / "short.h5"
        repeated(one, PERIOD).write(short)
    follow(short, folder / "warm", Options(), frame_time=FRAME_S / 2, quiet_time=0.1)
    writer = multiprocessing.get_context("spawn").Process(target=record, args=(period, path))
    writer.start()
    seen = follow(path, folder / "out", Options(), frame_time=FRAME_S, quiet_time=30.0)
    writer.join()
    told = seen.summary()
    done = {"live.frames": seen.frames, "live.dropped": seen.dropped, "live.frame_s": seen.frame_s}
    return done | {f"live.latency_{key}_s": told["latency_s"][key] for key in ("median", "max")}


def record(period: Path, path: Path) -> None:
    """Write a recording (HDF5, SWMR) in real time."""
    with Recording.open(period) as one, h5py.File(path, "w", libver="latest") as file:
        whole = repeated(one, round(LIVE_S * RATE))
        file.attrs.update({"format": "lissajous-recording", "version": 1})
        file.create_group("device").attrs["toml"] = whole.device_toml
        group = file.create_group("channels")
        for channel in whole.channels.values():
            dataset = group.create_dataset(channel.name, (0,), np.int16, maxshape=(None,), chunks=(1 << 16,))
            dataset.attrs.update({"unit": "V", "sample_rate": RATE, "gain": channel.gain})
        file.swmr_mode = True
        began = time.perf_counter()
        there = 0
        while there < round(LIVE_S * RATE):
            stop = min(round((time.perf_counter() - began) * RATE), round(LIVE_S * RATE))
            for channel in whole.channels.values():
                group[channel.name].resize((stop,))
                group[channel.name][there:stop] = channel.stored(there, stop)
                group[channel.name].flush()
            there = stop
            time.sleep(WRITTEN_EVERY)


def written(recording: Recording, folder: Path) -> Path:
    path = folder / "period.h5"
    recording.write(path)
    return path


def main(wanted: list[str]) -> None:
    results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    for part in (disk, disk_long, live, length, pixels, axes, longest):
        if not wanted or part.__name__ in wanted:
            print(f"{part.__name__} ...", file=sys.stderr)
            with tempfile.TemporaryDirectory() as folder:
                found = part(Path(folder))
            for key, value in found.items():
                print(f"{key:28} {value:12.4g}")
            results |= {key: float(f"{value:.4g}") for key, value in found.items()}
            RESULTS.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
