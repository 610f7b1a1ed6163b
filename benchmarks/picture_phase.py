"""Scans without a sense signal: phase from drive and picture alone, for several pictures, drifts and photon numbers.

Each case is the demo's scan (60 ms, 5 MS/s, 400 x 400) without its sense signal. Run:
python -m benchmarks.picture_phase [OUT.json]
"""

from __future__ import annotations

import json
import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from phantoms.experiment import Experiment, simulate_experiment
from phantoms.optics import Detector
from recon.evaluation import truth_from_simulation
from recon.imaging import blur
from recon.imaging.gridding import accumulate_samples, mean_picture
from recon.pipeline import reconstruct
from recon.steps.reconstruction import Options, Reconstruction
from scanner import devices
from scanner.device import Device
from scanner.recording import Recording


@dataclass(frozen=True)
class Case:
    """Target, relative drift of each stiffness, photons a sample, and whether the stated device is the true one."""

    target: str
    drift_x: float
    drift_y: float
    photons: float = 1000.0
    calibrated: bool = True


CASES = (
    Case("immunohistochemistry", -0.0012, -0.0012),
    Case("immunohistochemistry", 0.0012, 0.0012),
    Case("retina", -0.0012, 0.0012),
    Case("cell", 0.0012, -0.0012),
    Case("microaneurysms", -0.0012, -0.0012),
    Case("immunohistochemistry", -0.002, -0.002),
    Case("immunohistochemistry", -0.0012, 0.0012, photons=100.0),
    Case("retina", 0.0012, -0.0012, photons=10.0),
    Case("immunohistochemistry", -0.0012, -0.0012, calibrated=False),
    Case("cell", 0.0012, 0.0012, calibrated=False),
)


def miscalibrated() -> Device:
    """The imaging scanner with every stated value wrong by its tolerance."""
    device = devices.load("imaging")
    axes = {}
    for sign, (name, axis) in zip((1, -1), device.axes.items(), strict=True):
        m, c = axis.require_mechanics(), axis.require_capacitance()
        m = replace(m, k=m.k * (1 + 5e-4 * sign), b=m.b * (1 - 0.03 * sign))
        c = replace(c, C0=c.C0 * (1 + 0.01 * sign), theta0=c.theta0 * (1 - 0.01 * sign))
        axes[name] = replace(axis, mechanics=m, capacitance=c)
    return replace(device, axes=axes)


def run_case(case: Case, seed: int) -> dict[str, object]:
    """Results of a case: phase error, its standard deviation and coverage by axis, and the picture's error."""
    experiment = Experiment(
        target=case.target,
        drift={"x": case.drift_x, "y": case.drift_y},
        detector=Detector(photons_per_sample=case.photons, bits=12),
    )
    nominal = None if case.calibrated else miscalibrated()
    recording, truth_arrays = simulate_experiment(experiment, seed, nominal)
    channels = {n: (c.read(), c.unit, c.sample_rate, c.start) for n, c in recording.channels.items() if n != "sense"}
    truth = truth_from_simulation(truth_arrays)
    assert truth is not None
    result = reconstruct(Recording.from_arrays(channels, recording.device), Options(), truth, quiet=True)
    x, y = (truth.angles[axis][0] for axis in "xy")
    best = mean_picture(*accumulate_samples(x, y, channels["intensity"][0], result.picture.grid), result.picture.grid)
    assert truth.scene is not None
    flips = [result.evaluation[axis].mirrored for axis in "xy"]
    ratio = (
        blur.compare_with_scene(result.picture, truth.scene, *flips).rms
        / blur.compare_with_scene(best, truth.scene).rms
    )
    return asdict(case) | {axis: _axis(result, axis) for axis in "xy"} | {"picture_ratio": ratio, "s": result.seconds}


def _axis(result: Reconstruction, axis: str) -> dict[str, float]:
    error, estimate = result.evaluation[axis], result.motion.axes[axis]
    sd = np.interp(error.time, estimate.time, estimate.phase_sd)
    return {
        "drift_deg": float(np.degrees(np.ptp(estimate.phase))),
        "rmse_deg": float(np.degrees(error.phase_rmse)),
        "worst_deg": float(np.degrees(np.abs(error.phase).max())),
        "sd_deg": float(np.degrees(np.sqrt(np.mean(sd**2)))),
        "within_95": float(np.mean(np.abs(error.phase) < 1.96 * sd)),
        "magnification": float(1.0 + np.mean(error.amplitude)),
    }


def main() -> None:
    rows = []
    for seed, case in enumerate(CASES):
        rows.append(run_case(case, seed))
        print(json.dumps(rows[-1]), flush=True)
    axes = [row[axis] for row in rows for axis in "xy"]
    summary = {
        "worst_rmse_deg": max(axis["rmse_deg"] for axis in axes),  # type: ignore[index]
        "within_95": float(np.mean([axis["within_95"] for axis in axes])),  # type: ignore[index]
        "cases": rows,
    }
    if len(sys.argv) > 1:
        Path(sys.argv[1]).write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")
    print(json.dumps({name: summary[name] for name in ("worst_rmse_deg", "within_95")}))


if __name__ == "__main__":
    main()
