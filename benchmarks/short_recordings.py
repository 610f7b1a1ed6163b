"""Recordings of a few periods of the slower axis: phase error, stated standard deviation and coverage.

Two devices: the demo's (parametric drive, both axes on one capacitive electrode, stiffness drifting by 0.2 %), and two
axes with linear drive and position sensors. The standard deviation is that of the estimator, from the signal's noise;
``lissajous reconstruct`` adds that of a readout delay that no picture of so few samples determines.
Run: python -m benchmarks.short_recordings FIRST_SEED [SEEDS]
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import numpy as np

from estimation.estimate import estimate
from phantoms.forward import Plan, simulate
from phantoms.waveforms import Sine
from recon.evaluation import evaluate_axis, truth_from_simulation
from scanner import devices
from scanner.device import Axis, Device
from scanner.drift import Drift, exponential
from scanner.stages import Drive, Mechanics, Position

PERIODS = (2, 3, 5, 8, 16)

PARAMETRIC_HZ = {"x": 13840.0, "y": 3270.0}
LINEAR_HZ = {"x": 5449.0, "y": 2119.0}

QUALITY = 100.0
"""Of the axes with a position sensor: the motion is settled after the 50 ms that a simulated drive runs."""


def linear_device() -> Device:
    """Two axes with linear drive and position sensor, of 0.2 rad at a drive of 10 V and 1 % of noise."""
    axes = {}
    for name, frequency in LINEAR_HZ.items():
        w = 2 * np.pi * frequency
        mechanics = Mechanics(1e-10, 1e-10 * w / QUALITY, 1e-10 * w**2)
        drive = Drive("linear", 0.02 * mechanics.k / QUALITY)
        axes[name] = Axis(mechanics, drive=drive, readout=Position(10.0, 0.02), name=name)
    return Device("linear", axes)


def cases() -> Iterator[tuple[str, str, Device, Plan]]:
    """Device, estimator, device and plan of each case."""
    for periods in PERIODS:
        drives = {name: Sine(2 * frequency, 30.0, 30.0) for name, frequency in PARAMETRIC_HZ.items()}
        drift = {axis: Drift(exponential(-0.002, 0.025)) for axis in "xy"}
        plan = Plan(drives, periods / PARAMETRIC_HZ["y"], drift=drift)
        yield f"demo, {periods} periods", "tracker", devices.load("imaging"), plan
    for periods in PERIODS:
        drives = {name: Sine(frequency, 10.0) for name, frequency in LINEAR_HZ.items()}
        for estimator in ("sensor", "tracker"):
            plan = Plan(drives, periods / LINEAR_HZ["y"])
            yield f"linear, {periods} periods", estimator, linear_device(), plan


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("first", type=int, help="first seed")
    parser.add_argument("seeds", type=int, nargs="?", default=20)
    args = parser.parse_args()
    print("| device, length | estimator | axis | phase error | stated sd | blocks within 1.96 sd |")
    print("|---|---|---|---|---|---|")
    for name, estimator, device, plan in cases():
        errors: dict[str, list[float]] = {"x": [], "y": []}
        sds: dict[str, list[float]] = {"x": [], "y": []}
        for seed in range(args.first, args.first + args.seeds):
            recording, simulated = simulate(device, plan, seed=seed)
            truth = truth_from_simulation(simulated)
            assert truth is not None
            motion = estimate(recording, device, estimator)
            for axis, found in motion.axes.items():
                evaluation = evaluate_axis(found, *truth.angles[axis])
                errors[axis].extend(np.degrees(evaluation.phase))
                sds[axis].extend(np.degrees(np.interp(evaluation.time, found.time, found.phase_sd)))
        for axis in "xy":
            error, sd = np.array(errors[axis]), np.array(sds[axis])
            rms = [float(np.sqrt(np.mean(values**2))) for values in (error, sd)]
            covered = 100 * np.mean(np.abs(error) < 1.96 * sd)
            print(
                f"| {name} | {estimator} | {axis} | {rms[0]:.4f}° | {rms[1]:.4f}° | {covered:.0f} % of {error.size} |"
            )


if __name__ == "__main__":
    main()
