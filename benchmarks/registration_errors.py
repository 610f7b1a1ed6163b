"""Error of the phase that the picture alone shows, over its stated standard deviation, at the true positions.

    python -m benchmarks.registration_errors SCANS [--first SEED]

Every scan is that of ``readout_errors``: 40 ms, both resonances drifting. Its true positions are registered with the
intensity of each scene at each photon level, so that the readout and the estimator have no part in the result. Prints
the root mean square of the weighted mean over the scan and of its stated standard deviation, and their ratio, the root
mean square of error over standard deviation. A right standard deviation has a ratio of 1.
"""

from __future__ import annotations

import argparse

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.signal import hilbert

from benchmarks.readout_errors import DURATION_S, SCENES
from phantoms.experiment import Experiment, simulate_experiment
from phantoms.optics import Detector, blur_by_spot, detect, sample_scene
from phantoms.targets import make_target
from recon.evaluation import truth_from_simulation
from recon.imaging.picture import grid_of_scan
from recon.imaging.scan_phase.bidirectional_phase import measure_phase_errors
from scanner.arrays import Array

PHOTONS = (130.0, 300.0, 700.0)
SLICES = 5
PIXELS = 400
MEAN_SAMPLES = 2001
"""Samples over which the amplitude is averaged, 0.4 ms: the positions hold both directions many times."""


def amplitude(angle: Array) -> Array:
    """Amplitude of an oscillation at every sample, shape (n,) [rad]."""
    mirrored = np.concatenate([angle, angle[::-1]])
    return np.asarray(uniform_filter1d(np.abs(hilbert(mirrored)), MEAN_SAMPLES)[: angle.size])


def scan(seed: int) -> dict[tuple[str, float], Array]:
    """Mean phase error of x and y and its stated standard deviation [deg] by scene and photons, shape (2, 2)."""
    rng = np.random.default_rng([50, seed])
    drift = {axis: float(rng.uniform(-0.002, 0.002)) for axis in "xy"}
    experiment = Experiment(duration=DURATION_S, drift=drift)
    truth = truth_from_simulation(simulate_experiment(experiment, seed)[1])
    assert truth is not None
    angles = [truth.angles[axis][0] for axis in "xy"]
    rate, view = truth.angles["x"][1], experiment.device.require_scan()
    grid = grid_of_scan(PIXELS, PIXELS, view)
    amplitudes = [amplitude(angle) for angle in angles]
    found = {}
    for scene in SCENES:
        height_um = experiment.field_um * grid.half_angle_y / grid.half_angle_x
        blurred = blur_by_spot(make_target(scene), experiment.spot_um, experiment.field_um, height_um)
        light = sample_scene(blurred, *angles, grid.half_angle_x, grid.half_angle_y)
        for photons in PHOTONS:
            intensity = detect(light, rate, Detector(photons_per_sample=photons, bits=12), rng)
            measured = measure_phase_errors(*angles, intensity, rate, grid, *amplitudes, slices=SLICES)
            errors = [error.with_common_shift() for error in measured]
            value, sd = np.array([[error.x, error.y] for error in errors]).transpose(2, 0, 1)
            weight = np.where(np.isfinite(value), sd**-2.0, 0.0)
            mean = (weight * np.nan_to_num(value)).sum(axis=0) / weight.sum(axis=0)
            found[scene, photons] = np.degrees([mean, weight.sum(axis=0) ** -0.5])
    return found


def ratio(values: Array) -> float:
    """Root mean square of error over standard deviation, values of shape (n, 2)."""
    return float(np.sqrt(np.mean((values[:, 0] / values[:, 1]) ** 2)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scans", type=int, help="number of scans")
    parser.add_argument("--first", type=int, default=0, help="seed of the first scan")
    args = parser.parse_args()
    rows = [scan(seed) for seed in range(args.first, args.first + args.scans)]
    print("| scene | photons | x: error, stated, ratio | y: error, stated, ratio |\n| --- | --- | --- | --- |")
    everything = []
    for key in rows[0]:
        values = np.array([row[key] for row in rows])
        everything.append(values)
        rms = np.sqrt(np.mean(values**2, axis=0))
        cells = [f"{rms[0, i]:.4f}°, {rms[1, i]:.4f}°, {ratio(values[:, :, i]):.2f}" for i in range(2)]
        print(f"| {key[0]} | {key[1]:.0f} | {' | '.join(cells)} |")
    together = np.concatenate(everything)
    print(f"| all | | {' | '.join(f'{ratio(together[:, :, i]):.2f}' for i in range(2))} |")


if __name__ == "__main__":
    main()
