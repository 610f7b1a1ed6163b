"""LiDAR recordings with a known answer: ranges to a wall along the beams of a simulated scanner."""

from __future__ import annotations

import numpy as np

from scanner.arrays import Array
from scanner.device import Device
from scanner.geometry import Geometry, trace_rays
from scanner.recording import Recording


def measure_wall(geometry: Geometry, theta_x: Array, theta_y: Array, normal: Array, distance: float) -> Array:
    """Ranges to a wall without noise, shape (n,) [m]; nan where a beam misses it.

    Args:
        geometry: of the scanner.
        theta_x, theta_y: mechanical angles, shape (n,) [rad].
        normal: of the wall, of length 1, shape (3,).
        distance: of the wall from the origin [m].
    """
    origin, direction, path = trace_rays(geometry, theta_x, theta_y)
    towards = direction @ normal
    length = np.divide(distance - origin @ normal, towards, out=np.full(len(towards), np.nan), where=towards > 0.0)
    return np.where(length > 0.0, length + path + geometry.range_offset, np.nan)


def add_ranges(recording: Recording, device: Device, ranges: Array, every: int) -> Recording:
    """The recording with every ``every``-th range as channel ``range``, and the device that states its geometry.

    Args:
        recording: with an intensity, on whose clock ``ranges`` are.
        device: that the recording is to state.
        ranges: shape (n,) [m].
        every: samples of the intensity from one shot to the next.
    """
    channels = {name: (c.read(), c.unit, c.sample_rate, c.start) for name, c in recording.channels.items()}
    clock = recording["intensity"]
    channels["range"] = (ranges[::every], "m", clock.sample_rate / every, clock.start)
    return Recording.from_arrays(channels, device)
