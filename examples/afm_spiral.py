"""A measured scan: an atomic-force microscope's spiral over a grating, with and without its position sensors.

    python examples/afm_spiral.py DATA OUT

DATA contains spiral_20hz.mat and raster_20hz.mat. The spiral is gridded twice: with the position of the sensors and
with the commanded position. The grating is measured in both pictures and in that of the raster scan. 1 rad of the files
means 1 um, see afm_spiral.toml.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from grating import Grating, fft_wave, fit_grating

from estimation.estimate import estimate
from recon.imaging.gridding import map_samples
from recon.imaging.picture import Grid, Picture
from recon.io.convert import convert_file
from recon.io.readers import read
from scanner.arrays import Array
from scanner.device import Device
from scanner.recording import Recording

MAPPING = Path(__file__).with_suffix(".toml")
TURNS_PER_SECOND = 20.0
PIXELS = 128
V_PER_UM = 0.04 / 3
NM_PER_V = 1e4


@dataclass(frozen=True)
class Spiral:
    """Archimedean spiral at constant angular velocity: radius ``growth t``, angle ``2 pi rate t + phase``.

    Attributes:
        rate: turns a second, negative when clockwise [Hz].
        centre: x and y, shape (2,).
        growth: of the radius, a second.
        phase: angle at time 0 [rad].
    """

    rate: float
    centre: Array
    growth: float
    phase: float

    def at(self, time: Array) -> Array:
        """x and y at ``time`` (n,) [s], shape (2, n)."""
        angle = 2 * np.pi * self.rate * time + self.phase
        return self.centre[:, None] + self.growth * time * np.array([np.cos(angle), np.sin(angle)])


def fit_spiral(time: Array, path: Array, turns_per_second: float) -> Spiral:
    """The spiral, in either sense of rotation, that fits a measured path, shape (2, n), in least squares.

    It serves as the commanded path, with the smallest possible errors of centre, size and direction.
    """
    fits = []
    for rate in (turns_per_second, -turns_per_second):
        angle = 2 * np.pi * rate * time
        ones, zeros, c, s = np.ones_like(time), np.zeros_like(time), time * np.cos(angle), time * np.sin(angle)
        # linear in the centre and in growth * (cos, sin) of the phase
        design = np.concatenate([np.stack([ones, zeros, c, -s], 1), np.stack([zeros, ones, s, c], 1)])
        (cx, cy, a, b), misfit, *_ = np.linalg.lstsq(design, path.reshape(-1), rcond=None)
        fits.append((misfit.item(), Spiral(rate, np.array([cx, cy]), np.hypot(a, b), np.arctan2(b, a))))
    return min(fits, key=lambda fit: fit[0])[1]


def commanded(recording: Recording) -> Recording:
    """The recording of a stage without sensors: the commanded spiral replaces the position channels."""
    x, y, height = (recording[name] for name in ("sense_x", "sense_y", "intensity"))
    commanded_x, commanded_y = fit_spiral(x.time(), np.array([x.read(), y.read()]), TURNS_PER_SECOND).at(x.time())
    channels = {
        "sense_x": (commanded_x, x.unit, x.sample_rate, x.start),
        "sense_y": (commanded_y, y.unit, y.sample_rate, y.start),
        "intensity": (height.read(), height.unit, height.sample_rate, height.start),
    }
    return Recording.from_arrays(channels, recording.device, f"{recording.name}-commanded")


def spiral_picture(recording: Recording, device: Device) -> tuple[Picture, Array]:
    """Height [nm] over the field of the device, and the path of the samples, shape (2, n) [um]."""
    scan = device.require_scan()
    axes = estimate(recording, device).axes
    path = np.array([axes[name].angle.read() for name in ("x", "y")])
    grid = Grid(PIXELS, PIXELS, scan.half_angle_x, scan.half_angle_y)
    return map_samples(*path, recording["intensity"].read(), grid), path


def raster_picture(file: Path) -> Picture:
    """Height [nm] in the raster scan. Its lines are parts of a longer record, so that it has no continuous clock."""
    variables = read(file).variables
    raw = {name: variables[name].raw[:] for name in ("x", "y", "z")}
    x, y = ((raw[name] - (raw[name].min() + raw[name].max()) / 2) / V_PER_UM for name in ("x", "y"))
    return map_samples(x, y, NM_PER_V * raw["z"], Grid(PIXELS, PIXELS, x.max(), y.max()))


def table_row(name: str, picture: Picture, grating: Grating) -> str:
    """One row of the printed table: pitch by FFT and by fit, and bend of the lines."""
    by_fft, field = 1 / np.hypot(*fft_wave(picture)), 2 * picture.grid.half_angle_x
    return (
        f"{name:10} {by_fft:8.3f} ± {by_fft**2 / field / 2:5.3f} {grating.pitch:10.3f} ± {grating.pitch_sd:5.3f}"
        f" {grating.pitch * V_PER_UM:10.4f} ± {grating.pitch_sd * V_PER_UM:6.4f} {1e3 * grating.bend:9.0f}"
    )


def draw(pictures: dict[str, Picture], gratings: dict[str, Grating], output: Path) -> None:
    """Draw the pictures, and the deviation of the grating's lines from straight ones."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, grid_of_panels = plt.subplots(2, 2, figsize=(6.6, 6.4), layout="constrained")
    panels = grid_of_panels.ravel()
    for panel, (name, picture) in zip(panels, pictures.items(), strict=False):
        grid = picture.grid
        extent = (-grid.half_angle_x, grid.half_angle_x, -grid.half_angle_y, grid.half_angle_y)
        panel.set_facecolor("lightsteelblue")  # pixels without samples
        low, high = np.nanpercentile(picture.image, [1, 98.5])
        panel.imshow(picture.image, cmap="gray", vmin=low, vmax=high, origin="lower", extent=extent)
        panel.set(title=f"{name}: pitch {gratings[name].pitch:.3f} µm", xlabel="x (µm)", ylabel="y (µm)")
        panels[3].plot(gratings[name].along, 1e3 * gratings[name].deviation, "o-", label=name)
    panels[3].set(title="Deviation of the lines", xlabel="along the lines (µm)", ylabel="from a straight line (nm)")
    panels[3].legend()
    figure.savefig(output, dpi=160)
    plt.close(figure)


def main(data: Path, output: Path) -> None:
    """Convert, reconstruct, measure, draw."""
    output.mkdir(parents=True, exist_ok=True)
    convert_file(data / "spiral_20hz.mat", MAPPING, output / "afm_spiral.h5")
    with Recording.open(output / "afm_spiral.h5") as measured:
        device = measured.device
        commanded_recording = commanded(measured)
        commanded_recording.write(output / "afm_spiral_commanded.h5")
        sensors, path = spiral_picture(measured, device)
    commanded_picture, commanded_path = spiral_picture(commanded_recording, device)
    pictures = {"sensors": sensors, "commanded": commanded_picture, "raster": raster_picture(data / "raster_20hz.mat")}
    gratings = {name: fit_grating(picture) for name, picture in pictures.items()}

    print("Pitch of the grating. By FFT: ± half a cycle over the field. By fit: ± one standard deviation")
    print("               by FFT (µm)        by fit (µm)            by fit (V)     bend (nm)")
    for name, picture in pictures.items():
        print(table_row(name, picture, gratings[name]))
    difference = commanded_path - path
    rms, largest = np.sqrt(np.mean(difference**2, axis=1)), np.hypot(*difference).max()
    print(
        f"Commanded against measured position: rms {1e3 * rms[0]:.0f} nm in x ({1e3 * rms[0] * V_PER_UM:.2f} mV), "
        f"{1e3 * rms[1]:.0f} nm in y ({1e3 * rms[1] * V_PER_UM:.2f} mV), at most {1e3 * largest:.0f} nm"
    )
    draw(pictures, gratings, output / "afm_spiral.png")
    print(f"Pictures: {output / 'afm_spiral.png'}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
