"""What a device's optics terms did to a recording, undone: the light's clock and brightness, and the beam's place."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from scanner.channel import Lazy
from scanner.device import Device
from scanner.motion import AngleTrack, Motion
from scanner.optics import acting, delay, gain, place
from scanner.recording import Recording

Array = NDArray[np.float64]


def with_light(recording: Recording, device: Device) -> Recording:
    """The recording with an intensity whose clock and size are the light's, as far as the device's terms tell.

    A detector's lag is undone by its delay alone: sharpening what it smoothed would raise the noise.
    """
    if "intensity" not in recording or not acting(device, "intensity"):
        return recording
    channel = recording["intensity"]

    def bright(first: int, stop: int) -> Array:
        values = channel.read(first, stop)
        light = gain(device, channel.time(first, stop) - recording.start)
        return np.asarray(values / (light if values.ndim == 1 else light[:, None]))

    start = channel.start - delay(device, 1 / channel.sample_rate)
    light = replace(
        channel,
        raw=Lazy(channel.shape, np.dtype(np.float64), bright),
        first=0, stop=channel.size, gain=1.0, offset=0.0, start=start,
    )  # fmt: skip
    return replace(recording, channels=MappingProxyType({**recording.channels, "intensity": light}))


class PlacedAngle(AngleTrack):
    """Where on the sample the beam stood, told as an angle, made when it is read.

    Attributes:
        track: of the mirror.
    """

    def __init__(self, track: AngleTrack, device: Device, axis: str, origin: float):
        # frozen, as its parent
        self.__dict__.update(
            track=track, device=device, axis=axis, origin=origin, sample_rate=track.sample_rate, start=track.start
        )

    @property
    def size(self) -> int:
        """Number of samples."""
        return int(self.__dict__["track"].size)

    @property
    def values(self) -> Array:
        """All places, shape (size,) [rad]."""
        return self.read()

    def read(self, first: int = 0, stop: int | None = None) -> Array:
        """Places of samples ``first`` up to ``stop``, shape (n,) [rad]."""
        own = self.__dict__
        index = np.arange(*slice(first, stop).indices(self.size))
        time = self.start + index / self.sample_rate - own["origin"]
        return place(own["device"], own["axis"], own["track"].read(first, stop), time)


def placed(motion: Motion, device: Device, origin: float) -> Motion:
    """The motion of the beam over the sample: where the device's terms bend the field or move the sample.

    Args:
        origin: start of the recording [s].
    """
    axes = {
        name: replace(axis, angle=PlacedAngle(axis.angle, device, name, origin))
        if acting(device, "place", name)
        else axis
        for name, axis in motion.axes.items()
    }
    return replace(motion, axes=axes)
