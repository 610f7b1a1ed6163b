"""A scan of two sines over spots without symmetry: its light, position sensors and edges of detectors in the centre."""

from __future__ import annotations

import warnings

import numpy as np

import lissajous
from recon.steps.reconstruction import Reconstruction
from scanner.device import Device
from scanner.recording import Recording

RATE_HZ, SAMPLES, HALF_RAD = 1e6, 40_000, 0.08
FREQUENCIES_HZ = {"x": 1870.0, "y": 733.0}
FIELD = f"[scan]\nhalf_angle_x = {HALF_RAD}\nhalf_angle_y = {HALF_RAD}\n"
READOUTS = "".join(f'[{a}.readout]\nkind = "position"\ngain = 20.0\nnoise_sd = 2e-3\n' for a in "xy")
EDGES = "[x]\n[y]\n" + FIELD
TIME = np.arange(SAMPLES) / RATE_HZ


def angles(drift_rad: float = 0.1) -> dict[str, np.ndarray]:
    """Motion of both axes [rad], whose phases drift."""
    drift = drift_rad * TIME / TIME[-1]
    return {
        axis: 0.97 * HALF_RAD * np.sin(2 * np.pi * f * TIME + phase + drift)
        for (axis, f), phase in zip(FREQUENCIES_HZ.items(), (0.4, 1.9), strict=True)
    }


def light(seed: int, drift_rad: float = 0.1) -> np.ndarray:
    """Counts of a specimen of 60 spots without symmetry, as voltages."""
    rng = np.random.default_rng(seed)
    x, y = (angle / HALF_RAD for angle in angles(drift_rad).values())
    scene = np.full(SAMPLES, 0.2)
    for _ in range(60):
        column, row, size = *rng.uniform(-0.95, 0.95, 2), rng.uniform(0.02, 0.06)
        scene += rng.uniform(0.3, 1.0) * np.exp(-((x - column) ** 2 + (y - row) ** 2) / (2 * size**2))
    return rng.poisson(300.0 * scene) / 300.0


def sensors(seed: int) -> dict[str, tuple]:
    rng = np.random.default_rng(seed)
    return {f"sense_{a}": (20.0 * v + rng.normal(0.0, 2e-3, SAMPLES), "V", RATE_HZ) for a, v in angles().items()}


def reconstruct(channels: dict[str, tuple], device: str) -> Reconstruction:
    recording = Recording.from_arrays(channels, Device.from_toml(device))
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        return lissajous.reconstruct(recording, pixels=(80, 80))


def crossings(axis: str, upward: bool = True) -> np.ndarray:
    """Times at which the axis passes the centre [s]."""
    angle = angles()[axis]
    at = np.flatnonzero((angle[:-1] < 0.0) & (angle[1:] >= 0.0) if upward else angle[:-1] * angle[1:] < 0.0)
    return (at - angle[at] / (angle[at + 1] - angle[at])) / RATE_HZ


def edges(x: np.ndarray, y: np.ndarray) -> dict[str, tuple]:
    stated = {"event": "zero-crossing-up"}
    return {"sync_x": (x, "s", stated), "sync_y": (y, "s", stated), "intensity": (light(772001), "V", RATE_HZ)}
