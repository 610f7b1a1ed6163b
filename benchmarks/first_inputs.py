"""Inputs of ``benchmarks.first_pictures``: files as instruments write them, without truth, and their commands."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import tifffile

import lissajous
from benchmarks.first_scores import Use, load_axes, load_picture, picture_ratio, score_scan
from benchmarks.line_phase import SIDE_PX, draw_scene, left_between
from lissajous import Device, Recording
from phantoms.lidar import add_ranges, measure_wall
from phantoms.raster_film import count_photons, scan_raster_frame
from phantoms.sync import SyncDetector, sync_edges
from recon.evaluation import evaluate_axis
from recon.imaging.raster.line_phase import column_places, lag_at
from scanner import devices
from scanner.angle_tracks import SampledAngle
from scanner.arrays import Array
from scanner.geometry import Geometry
from scanner.motion import AxisMotion

RATE_HZ = 1e6
DRIVES: dict[str, Any] = {"drive_x": (2000.0, 13.5, 0.0), "drive_y": (835.0, 9.5, 0.0)}
"""Drive of the electromagnetic mirror: frequency [Hz], amplitude [V], offset [V]."""
READOUTS = {"position": "gain = 20.0\nnoise_sd = 2.0e-3", "velocity": "gain = 1.6e-3\nnoise_sd = 2.0e-3"}
MIRROR = """
name = "mirror"
[x.mechanics]
J = 1.0e-10
b = 1.25e-8
k = 1.579e-2
[x.drive]
kind = "linear"
torque_per_volt = 1.0e-6
[x.readout]
{readout}
[x.tolerance]
k = 0.01
b = 0.1
[y.mechanics]
J = 4.0e-10
b = 2.1e-8
k = 1.1e-2
[y.drive]
kind = "linear"
torque_per_volt = 1.0e-6
[y.readout]
{readout}
[y.tolerance]
k = 0.01
b = 0.1
[scan]
half_angle_x = 0.08
half_angle_y = 0.08
"""
"""The device file of the pages on position detectors and vibrometers."""
FOLDER_SIZE = 200


def _use(simulation: lissajous.Simulation, commands: list[str], **further: Any) -> Use:
    recording, truth = simulation
    view = recording.device.require_scan()
    return Use(
        commands,
        {axis: np.asarray(truth[f"angle_{axis}"][0]) for axis in "xy"},
        recording["intensity"].read(),
        np.asarray(truth["scene"][0] if isinstance(truth["scene"], tuple) else truth["scene"]),
        (view.half_angle_x, view.half_angle_y),
        recording["intensity"].sample_rate,
        **further,
    )


def _mirror_text(kind: str) -> str:
    return MIRROR.format(readout=f'kind = "{kind}"\n{READOUTS[kind]}')


def _simulate_mirror(seed: int, kind: str = "position", duration: float = 0.2) -> lissajous.Simulation:
    device = Device.from_toml(_mirror_text(kind))
    return lissajous.simulate(device, **DRIVES, duration=duration, sample_rate=RATE_HZ, drift=-0.001, seed=seed)


def _columns(recording: Recording, *names: str) -> list[Array]:
    return [recording[name].read() for name in names]


def _write_csv(path: Path, rate: float, columns: dict[str, Array]) -> None:
    first = next(iter(columns.values()))
    table = np.column_stack([np.arange(first.size) / rate, *columns.values()])
    head = ",".join(["Time (s)", *columns])
    np.savetxt(path, table, fmt=["%.9f"] + ["%.6g"] * len(columns), delimiter=",", header=head, comments="")


def scope_csv(folder: Path, seed: int) -> Use:
    """Four channels of an oscilloscope; no device file."""
    simulation = _simulate_mirror(seed)
    x, y, light, drive = _columns(simulation.recording, "sense_x", "sense_y", "intensity", "drive_x")
    _write_csv(folder / "capture.csv", RATE_HZ, {"CH1 (V)": x, "CH2 (V)": y, "CH3 (V)": light, "CH4 (V)": drive})
    new = "new-device --kind electromagnetic --resonance-x 2000 --q-x 100 --amplitude-x 0.08 "
    commands = [
        "info capture.csv",
        new + "--resonance-y 835 --q-y 140 --amplitude-y 0.08 -o device.toml",
        "convert capture.csv --channel sense_x=CH1 --channel sense_y=CH2 --channel intensity=CH3 "
        "--channel drive_x=CH4 -o scan.h5",
        "reconstruct scan.h5 --device device.toml -o out",
    ]
    return _use(simulation, commands)


def frequencies_only(folder: Path, seed: int) -> Use:
    """A photodiode and the frequencies of both drives."""
    simulation = lissajous.simulate(seed=seed)
    _write_csv(folder / "detector.csv", 5e6, {"CH1 (V)": simulation.recording["intensity"].read()})
    commands = [
        "new-device --kind parametric --frequencies-only --drive-frequency-x 27680 --drive-frequency-y 6540 "
        "--amplitude-x 0.18 --amplitude-y 0.18 -o device.toml",
        "convert detector.csv --channel intensity=CH1 -o scan.h5",
        "reconstruct scan.h5 --device device.toml -o out",
    ]
    return _use(simulation, commands)


def vibrometer(folder: Path, seed: int) -> Use:
    """Velocities, drives and intensity in an archive."""
    return _archive(folder, seed, "velocity", " --estimator tracker")


def position_detector(folder: Path, seed: int) -> Use:
    """Position detectors of an electromagnetic mirror, drives and intensity in an archive."""
    return _archive(folder, seed, "position", "")


def _archive(folder: Path, seed: int, kind: str, estimator: str) -> Use:
    simulation = _simulate_mirror(seed, kind)
    names = ("sense_x", "sense_y", "drive_x", "drive_y", "intensity")
    np.savez(folder / "scan.npz", **dict(zip(names, _columns(simulation.recording, *names), strict=True)))
    (folder / "device.toml").write_text(_mirror_text(kind))
    channels = " ".join(f"--channel {name}={name}" for name in names)
    commands = [
        f"convert scan.npz {channels} --unit V --rate 1e6 -o scan.h5",
        f"reconstruct scan.h5 --device device.toml{estimator} -o out",
    ]
    return _use(simulation, commands)


def sync(folder: Path, seed: int) -> Use:
    """Times of edges of both axes and the intensity; the file states no device but the field."""
    simulation = _simulate_mirror(seed)
    rng = np.random.default_rng(seed)
    detector = SyncDetector(0.02, jitter=1e-7, missing=0.01, doubled=0.01)
    edges = {
        f"edges_{axis}": 1e6 * sync_edges(np.asarray(simulation.truth[f"angle_{axis}"][0]), RATE_HZ, detector, rng)
        for axis in "xy"
    }
    np.savez(folder / "scan.npz", light=simulation.recording["intensity"].read(), **edges)
    parts = [f'[channels.sync_{axis}]\nvariable = "edges_{axis}"\nunit = "us"\nangle = 0.02\n' for axis in "xy"]
    (folder / "mapping.toml").write_text(
        '[channels.intensity]\nvariable = "light"\nunit = "V"\nsample_rate = 1.0e6\n'
        + "".join(parts)
        + '[device]\nname = "mirror"\n[device.x]\n[device.y]\n[device.scan]\nhalf_angle_x = 0.08\nhalf_angle_y = 0.08\n'
    )
    commands = ["convert scan.npz --mapping mapping.toml -o scan.h5", "reconstruct scan.h5 --estimator edges -o out"]
    return _use(simulation, commands)


def arrays(folder: Path, seed: int) -> Use:
    """Arrays in a program of four lines, as the notebook shows; its other lines write what is scored."""
    simulation = _simulate_mirror(seed)
    names = ("sense_x", "sense_y", "intensity")
    np.savez(folder / "arrays.npz", **dict(zip(names, _columns(simulation.recording, *names), strict=True)))
    (folder / "device.toml").write_text(_mirror_text("position"))
    (folder / "program.py").write_text(
        "import numpy as np\nimport lissajous\n"
        "arrays = dict(np.load('arrays.npz'))\n"
        "result = lissajous.reconstruct(arrays, 'device.toml', sample_rate=1e6)\n"
        "np.savez('result.npz', image=result.picture.image, coverage=result.picture.coverage,\n"
        "         **{a: m.angle.read() for a, m in result.motion.axes.items()},\n"
        "         **{'f' + a: m.frequency for a, m in result.motion.axes.items()})\n"
    )
    use = _use(simulation, ["python program.py"])

    def score(folder: Path) -> list[str]:
        with np.load(folder / "result.npz") as result:
            empty = np.empty(0)
            axes = {
                axis: evaluate_axis(
                    AxisMotion(empty, empty, empty, result["f" + axis], empty, SampledAngle(result[axis], RATE_HZ)),
                    angle,
                    RATE_HZ,
                    0.0,
                )
                for axis, angle in use.angles.items()
            }
            return [*score_scan(use, axes, result["image"], result["coverage"]), ""]

    return replace(use, score=score)


def two_detectors(folder: Path, seed: int) -> Use:
    """Two detectors in two columns."""
    simulation = _simulate_mirror(seed)
    x, y, light = _columns(simulation.recording, "sense_x", "sense_y", "intensity")
    second = 0.5 * light + np.random.default_rng(seed).normal(0.0, 0.05 * light.std(), light.size)
    _write_csv(folder / "capture.csv", RATE_HZ, {"X (V)": x, "Y (V)": y, "PMT1 (V)": light, "PMT2 (V)": second})
    (folder / "device.toml").write_text(_mirror_text("position"))
    commands = [
        "convert capture.csv --channel sense_x=X --channel sense_y=Y --channel intensity=PMT1,PMT2 -o scan.h5",
        "reconstruct scan.h5 --device device.toml -o out",
    ]

    def check(folder: Path) -> str:
        return "detectors " + ", ".join(json.loads((folder / "out" / "summary.json").read_text())["detectors"])

    return replace(_use(simulation, commands, check=check), light=np.column_stack([light, second]))


def film(folder: Path, seed: int) -> Use:
    """Frames of a scan as OME-TIFF, OME-Zarr and MP4."""
    simulation = _simulate_mirror(seed, duration=0.4)
    simulation.recording.write(folder / "scan.h5")

    def check(folder: Path) -> str:
        frames = tifffile.imread(folder / "out" / "frames.ome.tif")
        written = [name for name in ("frames.ome.zarr", "frames.mp4") if (folder / "out" / name).exists()]
        return f"{len(frames)} frames, {', '.join(written)}"

    command = "reconstruct scan.h5 -o out --pixels 200x200 --frame-time 0.1 --fill 2 --zarr --movie mp4"
    return _use(simulation, [command], check=check)


def folder_of_200(folder: Path, seed: int) -> Use:
    """A folder of recordings; the first run is killed, the same command continues it."""
    (folder / "recordings").mkdir()
    truths = {}
    for k in range(FOLDER_SIZE):
        simulation = _simulate_mirror(1000 * seed + k, duration=0.03)
        simulation.recording.write(folder / "recordings" / f"{k:03d}.h5")
        truths[f"{k:03d}"] = simulation
    command = "reconstruct recordings -o out --pixels 60x60 --workers 1"

    def score(folder: Path) -> list[str]:
        scans = []
        for name, simulation in truths.items():
            use = _use(simulation, [])
            out = folder / "out" / name
            axes = load_axes(out / "motion.h5", use)
            ratio = picture_ratio(use, axes, *load_picture(out))
            scans.append([*(np.degrees(axis.phase_rmse) for axis in axes.values()), ratio])
        x, y, ratio = np.max(scans, axis=0)
        return [f"at most {x:.3f}°, {y:.3f}°", f"at most {ratio:.3f}", f"{len(scans)} recordings, killed once"]

    empty = np.empty(0)
    return Use(["interrupted " + command, command], {}, empty, empty, (0.08, 0.08), RATE_HZ, score=score)


def lidar(folder: Path, seed: int) -> Use:
    """Ranges to a wall 8 m away, noise 10 mm, as points; of the four signs, those of the flattest wall."""
    geometry = Geometry(incidence=np.radians(30.0), axis_offset=0.002, range_offset=0.05, range_sd=0.01)
    device = replace(devices.load("imaging"), geometry=geometry)
    simulation = lissajous.simulate(device, duration=0.04, seed=seed)
    signs = ("", " --flip-x", " --flip-y", " --flip-x --flip-y")
    normal = np.array([np.sin(0.35), 0.0, np.cos(0.35)])
    use = _use(simulation, [f"point-cloud scan.h5 -o out{k}{flips}" for k, flips in enumerate(signs)])
    exact = measure_wall(geometry, use.angles["x"], use.angles["y"], normal, 8.0)
    noisy = exact + np.random.default_rng(seed).normal(0.0, 0.01, exact.size)
    add_ranges(simulation.recording, device, noisy, 5).write(folder / "scan.h5")

    def score(folder: Path) -> list[str]:
        from pypcd4 import PointCloud

        residuals = []
        for k in range(len(signs)):
            points = PointCloud.from_path(folder / f"out{k}" / "points.pcd").numpy(("x", "y", "z")).astype(float)
            residuals.append(np.sqrt(np.mean(np.square(points @ normal - 8.0))))
        return ["", "", f"wall {1e3 * min(residuals):.1f} mm rms at 10 mm of range noise"]

    return replace(use, score=score)


def raster_film(folder: Path, seed: int) -> Use:
    """A film of a two-photon microscope whose line phase walks."""
    rng = np.random.default_rng(seed)
    picture = draw_scene("cells", seed)
    truth = 3.0 + np.cumsum(rng.normal(0.0, 0.02, 20))
    frames = [scan_raster_frame(picture, (SIDE_PX, SIDE_PX), shift, 0.85) for shift in truth]
    counts = np.array([count_photons(frame, 20.0, seed + k) for k, frame in enumerate(frames)])
    tifffile.imwrite(folder / "film.tif", counts, photometric="minisblack")

    def score(folder: Path) -> list[str]:
        table = np.genfromtxt(folder / "out" / "phase.csv", delimiter=",", names=True)
        summary = json.loads((folder / "out" / "summary.json").read_text())
        lag = lag_at(column_places(SIDE_PX), 0.85**2)
        left = left_between(
            truth, lag, table["shift_px"], lag_at(column_places(SIDE_PX), summary["fill_fraction"]["value"] ** 2)
        )
        return ["", "", f"{left:.3f} px left between directions of {truth.mean():.1f} px"]

    empty = np.empty(0)
    return Use(["bidirectional film.tif -o out"], {}, empty, empty, (1.0, 1.0), 1.0, score=score)


USES: dict[str, Callable[[Path, int], Use]] = {
    "scope-csv": scope_csv,
    "frequencies-only": frequencies_only,
    "vibrometer": vibrometer,
    "position-detector": position_detector,
    "sync-edges": sync,
    "arrays": arrays,
    "two-detectors": two_detectors,
    "film": film,
    "folder-of-200": folder_of_200,
    "lidar": lidar,
    "raster-film": raster_film,
}
