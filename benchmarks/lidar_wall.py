"""A wall measured by simulated LiDAR scanners: residual over the range noise, and distortion without the geometry.

    python -m benchmarks.lidar_wall [--first SEED]

The demo's scanner, both axes on one electrode, 40 ms at 1 million shots a second, both resonances drifting; range noise
of 10 mm; a wall 8 m away, inclined by 20 degrees. The plain raster takes azimuth and elevation as twice the mirror's
angles. Distortion is the displacement of points without range noise, rms.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from phantoms.experiment import Experiment, simulate_experiment
from phantoms.lidar import add_ranges, measure_wall
from recon.point_cloud import make_point_cloud
from recon.steps.reconstruction import Options
from scanner import devices
from scanner.arrays import Array
from scanner.geometry import Geometry, locate_points, trace_rays

RANGE_SD_M = 0.01
EVERY = 5
WALL_NORMAL = np.array([np.sin(0.35), 0.0, np.cos(0.35)])
WALL_M = 8.0
SCANNERS = {
    "beam along the normal": Geometry(range_sd=RANGE_SD_M),
    "beam at 30°": Geometry(incidence=np.radians(30.0), axis_offset=0.002, range_offset=0.05, range_sd=RANGE_SD_M),
    "beam at 45°, outer axis y, wide-angle lens": Geometry(
        incidence=np.radians(45.0), order="yx", magnification=1.5, distortion=(-0.15, 0.02), range_sd=RANGE_SD_M
    ),
    "two mirrors, 15 mm apart": Geometry(kind="two-mirror", axis_offset=0.015, range_sd=RANGE_SD_M),
}


def plain_raster(theta_x: Array, theta_y: Array, distance: Array) -> Array:
    """Points if azimuth and elevation are twice the mirror's angles, shape (n, 3) [m]."""
    x, y = 2.0 * theta_x, 2.0 * theta_y
    return distance[:, None] * np.stack([np.cos(y) * np.sin(x), np.sin(y), np.cos(y) * np.cos(x)], axis=1)


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def measure(geometry: Geometry, seed: int) -> list[str]:
    """Residual over the noise, distortion of the plain raster, of the result, and the part that is removed."""
    device = replace(devices.load("imaging"), geometry=geometry)
    recording, truth = simulate_experiment(Experiment(device=device, duration=0.04), seed)
    theta = {axis: np.asarray(truth[f"angle_{axis}"][0]) for axis in "xy"}
    exact = measure_wall(geometry, theta["x"], theta["y"], WALL_NORMAL, WALL_M)
    noise = np.random.default_rng(seed).normal(0.0, RANGE_SD_M, exact.size)
    result = make_point_cloud(add_ranges(recording, device, exact + noise, EVERY), Options(), quiet=True)
    flips = {axis: bool(np.sign(each) < 0) for axis, each in _signs(result.position, theta, geometry, exact).items()}
    if any(flips.values()):
        options = Options(flips=flips)
        result = make_point_cloud(add_ranges(recording, device, exact + noise, EVERY), options, quiet=True)
    shots = slice(None, None, EVERY)
    x, y, exact, noise = theta["x"][shots], theta["y"][shots], exact[shots], noise[shots]
    true_points = locate_points(geometry, x, y, exact)
    _, direction, _ = trace_rays(geometry, x, y)
    residual = (result.position @ WALL_NORMAL - WALL_M) / (direction @ WALL_NORMAL)
    own = result.position - noise[:, None] * direction
    left, plain = rms(own - true_points), rms(plain_raster(x, y, exact) - true_points)
    inside = np.abs(result.position[:, 0] - true_points[:, 0]) < 1.96 * np.sqrt(result.covariance[:, 0])
    return [
        f"{rms(residual) / RANGE_SD_M:.3f}",
        f"{1e3 * plain:.1f} mm",
        f"{1e3 * left:.2f} mm",
        f"{100 * (1 - left / plain):.2f} %",
        f"{100 * np.mean(inside):.1f} %",
    ]


def _signs(position: Array, theta: dict[str, Array], geometry: Geometry, exact: Array) -> dict[str, float]:
    """Correlation of the points' x and y with the true ones: negative where the sign of an axis is turned."""
    true = locate_points(geometry, theta["x"][::EVERY], theta["y"][::EVERY], exact[::EVERY])
    return {axis: float(np.corrcoef(position[:, k], true[:, k])[0, 1]) for k, axis in enumerate("xy")}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=int, default=0, metavar="SEED")
    args = parser.parse_args()
    head = ["scanner", "wall residual over range noise", "plain raster", "point-cloud", "removed"]
    head += ["95 % intervals of x hold"]
    print("| " + " | ".join(head) + " |\n|" + " --- |" * len(head))
    for k, (name, geometry) in enumerate(SCANNERS.items()):
        print("| " + " | ".join([name, *measure(geometry, args.first + k)]) + " |", flush=True)


if __name__ == "__main__":
    main()
