"""Phase error of pictures from drive frequencies, field and intensity alone: simulated scans of seeds given.

python -m benchmarks.frequencies_only 7101 7102 7103 7104
"""

from __future__ import annotations

import sys

import numpy as np

import lissajous
from scanner.device import Device
from scanner.device_templates import KnownAxis, new_device

CONDITIONS = (
    ("demo", 0.0, {}),
    ("20 photons", 0.0, {"photons": 20.0}),
    ("frequencies 5 Hz off", 5.0, {}),
    ("cell", 0.0, {"target": "cell", "drift": 0.0012}),
)
"""Name, error of the stated drive frequencies [Hz] and arguments of the simulation, one for each seed in turn."""

DRIVES_HZ = {"x": 27680.0, "y": 6540.0}


def main(seeds: list[int]) -> None:
    """Print one line of Markdown for each seed."""
    print("| scan | seed | phase error rms x, y | `phase_sd` rms x, y | change of the amplitude, error rms x, y |")
    print("|---|---|---|---|---|")
    for seed, (name, off, changed) in zip(seeds, CONDITIONS * len(seeds), strict=False):
        simulation = lissajous.simulate(seed=seed, **changed)
        channel = simulation.recording["intensity"]
        known = {axis: KnownAxis(amplitude=0.18, drive_frequency=hz + off) for axis, hz in DRIVES_HZ.items()}
        device = Device.from_toml(new_device("parametric", known, frequencies_only=True))
        stored = {"intensity": (channel.read(), channel.unit, channel.sample_rate, channel.start)}
        recording = lissajous.Recording.from_arrays(stored, device)
        result = lissajous.reconstruct(recording, truth=simulation.truth)
        errors = [result.evaluation[axis] for axis in "xy"]
        phase = ", ".join(f"{np.degrees(error.phase_rmse):.3f}°" for error in errors)
        sd = ", ".join(f"{np.degrees(np.sqrt(np.mean(result.motion.axes[axis].phase_sd ** 2))):.3f}°" for axis in "xy")
        amplitude = ", ".join(f"{100 * np.std(error.amplitude):.2f} %" for error in errors)
        print(f"| {name} | {seed} | {phase} | {sd} | {amplitude} |", flush=True)


if __name__ == "__main__":
    main([int(text) for text in sys.argv[1:]])
