"""A scan whose sensors show the position of the mirror, over a scene with detail."""

from __future__ import annotations

import numpy as np

from lissajous import Device, Recording
from phantoms.optics import sample_scene
from phantoms.targets import make_target

FREQUENCY_HZ = {"x": 4137.0, "y": 911.0}
NOISE_SD_V = 1e-4
READOUTS = "".join(f'[{axis}.readout]\nkind = "position"\ngain = 1.0\nnoise_sd = {NOISE_SD_V}\n' for axis in "xy")
DEVICE = Device.from_toml(f"{READOUTS}[scan]\nhalf_angle_x = 0.1\nhalf_angle_y = 0.1\n")


def position_scan(samples: int, rate_hz: float, start_s: float = 0.0, lost: slice = slice(0)) -> Recording:
    """The recording.

    Args:
        samples: of the sensors.
        rate_hz: of all channels.
        start_s: stated start of the intensity, which begins with the sensors.
        lost: samples that the intensity lacks.
    """
    rng, time = np.random.default_rng(3), np.arange(samples) / rate_hz
    angles = {axis: 0.1 * np.sin(2 * np.pi * f * time + 0.4) for axis, f in FREQUENCY_HZ.items()}
    scene = make_target("immunohistochemistry", (256, 256))
    light = sample_scene(scene / scene.max(), 10 * angles["x"], 10 * angles["y"], 1.0, 1.0)
    counts = np.delete(rng.poisson(100.0 * light).astype(float), lost)
    channels: dict[str, tuple] = {"intensity": (counts, "counts", rate_hz, start_s)}
    for axis, angle in angles.items():
        channels[f"sense_{axis}"] = (angle + rng.normal(0.0, NOISE_SD_V, samples), "V", rate_hz)
    return Recording.from_arrays(channels, DEVICE)
