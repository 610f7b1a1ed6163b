"""Transient and swept motion: noise in the angle gives no bias."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lsim

from estimation.identification.calibrate import identify
from scanner.device import Axis, Device
from scanner.recording import Recording
from scanner.stages import Drive, Mechanics, Position

RATE, SAMPLES, RESONANCE_HZ, QUALITY, LARGEST = 50e3, 5000, 2000.0, 8.0, 0.08
OMEGA = 2.0 * np.pi * RESONANCE_HZ
MECHANICS = Mechanics(1e-9, 1e-9 * OMEGA / QUALITY, 1e-9 * OMEGA**2)
DEVICE = Device(
    "resonator",
    {
        "x": Axis(
            MECHANICS,
            drive=Drive("linear", LARGEST * MECHANICS.k / QUALITY),
            readout=Position(10.0, 1e-3),
            name="x",
        )
    },
)


def recording(frequency: np.ndarray, level: np.ndarray, noise: float, seed: int) -> Recording:
    """Angle and drive of a linear resonator, simulated four times finer, with white noise of the angle [rad]."""
    turns = 2.0 * np.pi * np.cumsum(frequency) / (4.0 * RATE)
    voltage = level * np.sin(turns)
    m, torque = MECHANICS, LARGEST * MECHANICS.k / QUALITY
    _, angle, _ = lsim(([torque], [m.J, m.b, m.k]), voltage, np.arange(voltage.size) / (4.0 * RATE))
    angle = angle[::4] + noise * np.random.default_rng(seed).standard_normal(SAMPLES)
    return Recording.from_arrays({"angle_x": (angle, "rad", RATE), "drive_x": (voltage[::4], "V", RATE)})


@pytest.mark.parametrize("motion", ["steps", "sweep"])
def test_strong_noise_of_the_angle_gives_no_bias(motion: str) -> None:
    """Noise of an eighth of the signal: in steps of the amplitude b/J was 18 % too small, in 3 standard deviations."""
    part = np.arange(4 * SAMPLES) / (4 * SAMPLES)
    if motion == "steps":
        level = gaussian_filter1d(np.array([0.3, 1.0, 0.5, 0.1])[(4 * part).astype(int)], 400.0)
        frequency = np.full(part.size, RESONANCE_HZ * (1.0 + 0.2 / QUALITY))
    else:
        level, frequency = np.ones(part.size), RESONANCE_HZ * (0.8 + 0.4 * part)
    errors = []
    for seed in range(40):
        values = identify([recording(frequency, level, 0.01, seed)], DEVICE).values["x"]
        for key, true in (("k_over_J", OMEGA**2), ("b_over_J", OMEGA / QUALITY)):
            errors.append((values[key].value - true) / values[key].sd)
    found = np.reshape(errors, (-1, 2))
    assert np.all(np.abs(found.mean(axis=0)) < 4.0 / np.sqrt(len(found)))
    assert np.all(np.sqrt(np.mean(found**2, axis=0)) < 1.4)
