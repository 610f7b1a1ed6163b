"""Drives and intensity, and a device file whose stiffnesses are off by draws within their tolerances.

python -m benchmarks.response_phase --first 61700 --count 16
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

import lissajous
from phantoms.experiment import Experiment, simulate_experiment
from phantoms.waveforms import Sine
from scanner import devices
from scanner.device import Device
from scanner.device_templates import KnownAxis, new_device

DRIVES_HZ = {"x": 13840.0, "y": 3270.0}
"""Drive frequencies of the linear kind, and half of those of the combs [Hz]."""

TOLERANCES = {"combs": 0.005, "linear": 0.015}
"""Relative standard deviation of the stiffness, stated and drawn."""

DETUNING_SD = 0.004
"""Relative standard deviation of the resonances of the linear kind about the drive frequencies."""

QUALITY, AMPLITUDE_RAD = 100.0, 0.17
"""Of the linear kind."""


def simulated(kind: str, seed: int) -> tuple[lissajous.Recording, dict, Device]:
    """A recording of 30 ms, its truth and its device."""
    if kind == "combs":
        recording, truth = simulate_experiment(Experiment(duration=0.03, sample_rate=2.5e6), seed)
        return recording, truth, devices.load("imaging")
    rng = np.random.default_rng(seed)
    known = {a: KnownAxis(f * (1 + DETUNING_SD * rng.normal()), QUALITY, 0.18, f) for a, f in DRIVES_HZ.items()}
    device, drives = Device.from_toml(new_device("electromagnetic", known)), {}
    for axis, hz in DRIVES_HZ.items():
        m, drive, w = device.axis(axis).require_mechanics(), device.axis(axis).drive, 2 * np.pi * hz
        volts = AMPLITUDE_RAD * abs(m.k - m.J * w**2 + 1j * m.b * w) / ((drive and drive.torque_per_volt) or np.nan)
        drives[axis] = Sine(hz, volts, 0.0)
    drift = {"x": -0.001, "y": -0.001}
    experiment = Experiment(device=device, drives=drives, duration=0.03, sample_rate=2.5e6, drift=drift)
    return *simulate_experiment(experiment, seed), device


def main() -> None:
    """Print one line of Markdown for each seed; even ones are of the linear kind, odd ones of combs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--first", type=int, required=True)
    parser.add_argument("--count", type=int, default=16)
    args = parser.parse_args()
    print("| drive | seed | stiffness of the file x, y | phase error rms | `phase_sd` rms | amplitude, mean error |")
    print("|---|---|---|---|---|---|")
    for seed in range(args.first, args.first + args.count):
        kind = "combs" if seed % 2 else "linear"
        recording, truth, device = simulated(kind, seed)
        rng, axes, off = np.random.default_rng([seed, 1]), {}, []
        for name, axis in device.axes.items():
            off.append(float(TOLERANCES[kind] * rng.normal()))
            mechanics = axis.require_mechanics()
            mechanics = replace(mechanics, k=mechanics.k * (1 + off[-1]))
            tolerance = {**axis.tolerance, "k": TOLERANCES[kind]}
            axes[name] = replace(axis, mechanics=mechanics, tolerance=tolerance, readout=None)
        kept = {name: recording[name] for name in ("drive_x", "drive_y", "intensity")}
        stored = {name: (each.read(), each.unit, each.sample_rate, each.start) for name, each in kept.items()}
        stripped = lissajous.Recording.from_arrays(stored, replace(device, axes=axes, readout=None))
        head = f"| {kind} | {seed} | {100 * off[0]:+.2f} %, {100 * off[1]:+.2f} % |"
        try:
            result = lissajous.reconstruct(stripped, truth=truth, pixels=(200, 200), allow_outside=True)
        except lissajous.BadInput as error:
            print(head, f"refused: {error} | | |", flush=True)
            continue
        motion, found = result.motion.axes, [result.evaluation[name] for name in "xy"]
        phase = ", ".join(f"{np.degrees(each.phase_rmse):.3f}°" for each in found)
        sd = ", ".join(f"{np.degrees(np.sqrt(np.mean(motion[name].phase_sd ** 2))):.3f}°" for name in "xy")
        amplitude = ", ".join(f"{100 * np.mean(each.amplitude):+.1f} %" for each in found)
        print(head, f"{phase} | {sd} | {amplitude} |", flush=True)


if __name__ == "__main__":
    main()
