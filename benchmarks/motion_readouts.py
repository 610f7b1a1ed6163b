"""The tracker behind sensors of position, velocity and acceleration: phase error and coverage of its interval.

    python -m benchmarks.motion_readouts

A mirror at 1 kHz, Q 50, is driven at 1003 Hz for 0.2 s; its resonance drifts. The
three sensors have the same ratio of signal to noise.
"""

from __future__ import annotations

import numpy as np

from estimation.estimate import estimate
from phantoms.forward import Plan, simulate
from phantoms.waveforms import Sine
from recon.evaluation import evaluate_axis, truth_from_simulation
from scanner.device import Axis, Device
from scanner.drift import Drift, exponential
from scanner.stages import Acceleration, Drive, Mechanics, MotionSensor, Position, Velocity

RATE_RAD_S, NOISE_SD_V = 2 * np.pi * 1000.0, 0.1
SENSORS = (
    Position(10.0, NOISE_SD_V), Velocity(10.0 / RATE_RAD_S, NOISE_SD_V), Acceleration(10.0 / RATE_RAD_S**2, NOISE_SD_V)
)  # fmt: skip
SEEDS = range(7300, 7320)


def device(readout: MotionSensor) -> Device:
    mechanics = Mechanics(1e-10, 1e-10 * RATE_RAD_S / 50, 1e-10 * RATE_RAD_S**2)
    return Device("mirror", {"x": Axis(mechanics, drive=Drive("linear", 1e-6), readout=readout, name="x")})


def main() -> None:
    plan = Plan({"x": Sine(1003.0, 8.0)}, 0.2, 1e5, settle=0.1, drift={"x": Drift(exponential(-0.005, 0.05))})
    for sensor in SENSORS:
        errors, inside = [], []
        for seed in SEEDS:
            recording, stored = simulate(device(sensor), plan, seed=seed)
            truth = truth_from_simulation(stored)
            assert truth is not None
            axis = estimate(recording, method="tracker").axes["x"]
            result = evaluate_axis(axis, *truth.angles["x"])
            errors.append(result.phase)
            sd = np.interp(result.time, axis.time, axis.phase_sd)
            inside.append(np.mean(np.abs(result.phase) < 1.96 * sd))
        error = np.rad2deg(np.sqrt(np.mean(np.square(errors))))
        print(f"{sensor.kind}: {error:.4f} deg rms, {np.mean(inside):.1%} within the 95 % interval")


if __name__ == "__main__":
    main()
