"""Correction of a recording for its device's optics terms: time and size of the intensity, position of the beam."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from estimation.optics.detector_inverse import (
    MEASURED_SAMPLES,
    REACH,
    detector_corners,
    inverse_filter,
    measure_regularisation,
    undo_low_pass,
)
from scanner.angle_tracks import DerivedAngle
from scanner.arrays import Array
from scanner.channel import LazySamples
from scanner.device import Device
from scanner.motion import Motion
from scanner.optics import beam_position, intensity_delay, intensity_gain, terms_on_channel
from scanner.recording import Recording


def correct_intensity(recording: Recording, device: Device, undo_lag: bool = False) -> Recording:
    """The recording with its intensity corrected for the delay and the gain of the device's optics terms.

    Samples are corrected as they are read.

    Args:
        recording: with or without an intensity.
        device: states the terms.
        undo_lag: undo the low-pass of a slow detector, which raises electronic noise; otherwise only its delay is
            corrected.
    """
    if "intensity" not in recording or not terms_on_channel(device, "intensity"):
        return recording
    channel = recording["intensity"]
    step = 1 / channel.sample_rate
    corners = detector_corners(device) if undo_lag else []
    measured = channel.read(0, min(MEASURED_SAMPLES, channel.size) if corners else 0)
    filters = [inverse_filter(corner, step, measure_regularisation(measured, corner, step)) for corner in corners]
    before, after = len(filters) * (REACH + 1), len(filters) * REACH

    def corrected(first: int, stop: int) -> Array:
        if stop <= first:
            return channel.read(first, first)
        # Before the first sample and after the last one the intensity is taken as constant.
        index = np.arange(first - before, stop + after)
        start = max(first - before, 0)
        values = channel.read(start, min(stop + after, channel.size))
        values = values[np.clip(index - start, 0, len(values) - 1)]
        for weights in filters:
            values = undo_low_pass(values, weights)
        gain = intensity_gain(device, channel.time(first, stop) - recording.origin)
        return np.asarray(values / (gain if values.ndim == 1 else gain[:, None]))

    removed = sum(1 / (2 * np.pi * corner) for corner in corners)
    start = channel.start - intensity_delay(device, step) + removed
    intensity = replace(
        channel,
        raw=LazySamples(channel.shape, np.dtype(np.float64), corrected),
        first=0, stop=channel.size, gain=1.0, offset=0.0, start=start,
    )  # fmt: skip
    return recording.with_channel(intensity)


@dataclass(frozen=True)
class BeamAngle(DerivedAngle):
    """Position of the beam on the sample, as the mirror angle that would put it there.

    The track is that of the mirror.

    Attributes:
        device: holds the optics terms.
        axis: name of the axis.
        origin: start of the recording, which is the time origin of the terms [s].
    """

    device: Device
    axis: str
    origin: float

    def read(self, first: int = 0, stop: int | None = None) -> Array:
        """Return the positions of samples ``first`` up to ``stop`` (as in a Python slice), shape (n,) [rad]."""
        index = np.arange(*slice(first, stop).indices(self.size))
        time = self.start + index / self.sample_rate - self.origin
        return beam_position(self.device, self.axis, self.track.read(first, stop), time)

    def advanced(self, time: Array, phase: Array, frequency: Array) -> BeamAngle:
        """Return the positions for the motion of the mirror that is ahead (see ``scanner.angle_tracks.AngleTrack``)."""
        return replace(self, track=self.track.advanced(time, phase, frequency))


def beam_motion(motion: Motion, device: Device, origin: float) -> Motion:
    """The motion of the beam over the sample: the mirror's, displaced by the device's optics terms.

    Args:
        motion: of the mirror.
        origin: start of the recording [s].

    Returns:
        the motion with the angles of the affected axes replaced; axes without such terms are unchanged.
    """
    axes = {
        name: replace(axis, angle=BeamAngle(axis.angle, device, name, origin))
        if terms_on_channel(device, "place", name)
        else axis
        for name, axis in motion.axes.items()
    }
    return replace(motion, axes=axes)
