"""Simulated recordings of stacks: one motion of the beam over scenes that differ by slice."""

from functools import cache

import numpy as np

from phantoms.optics import Detector, blur_by_spot, detect, sample_scene
from phantoms.targets import make_target
from scanner.channel import make_channel
from scanner.recording import Recording
from tests.support.simulated import imaging

POSITIONS = (10e-6, 12e-6, 14e-6)
MOVE_S = 0.002
Z_RATE_HZ = 20e3
DURATION_S = 0.06


def staircase(time: np.ndarray, positions: tuple[float, ...], move: float, duration: float = DURATION_S) -> np.ndarray:
    """z that rests equally long at each position and moves at constant speed at the end of each rest [m]."""
    dwell = duration / len(positions)
    ends = dwell * np.arange(1, len(positions))
    return np.interp(time, np.column_stack([ends - move, ends]).ravel(), np.repeat(positions, 2)[1:-1])


@cache
def lights() -> tuple[np.ndarray, ...]:
    """Detector's signal of each scene along the motion of one scan."""
    recording, truth = imaging(DURATION_S)
    scan = recording.device.require_scan()
    angles = truth["angle_x"][0], truth["angle_y"][0]
    detector = Detector(photons_per_sample=1000.0, bits=12)
    tissue = blur_by_spot(make_target("immunohistochemistry"), 0.4, 250.0, 250.0)
    return tuple(
        detect(sample_scene(scene, *angles, *scan.mechanical_half_angles), 5e6, detector, np.random.default_rng(k))
        for k, scene in enumerate((tissue, np.rot90(tissue), 1.0 - np.rot90(tissue, 2)))
    )


def recording_of(light: np.ndarray, z: np.ndarray | None = None, z_rate: float = Z_RATE_HZ) -> Recording:
    """The scan with this intensity and z."""
    recording, _ = imaging(DURATION_S)
    recording = recording.with_channel(make_channel("intensity", light, unit="V", sample_rate=5e6))
    if z is None:
        return recording
    return recording.with_channel(make_channel("position_z", z, unit="m", sample_rate=z_rate))


def stack(z: np.ndarray | None = None, positions: tuple[float, ...] = POSITIONS) -> Recording:
    """A scan over different scenes at ``positions``, with 20 nm of noise in z unless ``z`` is given."""
    time = np.arange(round(5e6 * DURATION_S)) / 5e6
    middles = 0.5 * (np.array(positions[1:]) + np.array(positions[:-1]))
    scene = np.searchsorted(middles, staircase(time, positions, MOVE_S))
    light = np.choose(scene, lights())
    if z is None:
        times = np.arange(round(Z_RATE_HZ * DURATION_S)) / Z_RATE_HZ
        z = staircase(times, positions, MOVE_S) + np.random.default_rng(5).normal(0.0, 20e-9, times.size)
    return recording_of(light, z)
