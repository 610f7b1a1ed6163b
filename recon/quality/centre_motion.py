"""Whether the centre of a resonant motion moves in a position signal without a torque: hum or drift of the sensor."""

from __future__ import annotations

from math import sqrt

import numpy as np

from estimation.signals import white_noise_sd
from estimation.tracker.track import MIN_RELATIVE_FREQUENCY
from recon.imaging.picture import Grid
from scanner.arrays import Array
from scanner.device import Axis, Device
from scanner.motion import Motion
from scanner.recording import Recording

MAX_READ_SAMPLES = 1 << 22
"""Samples from the start in which the centre is measured: 32 MB of doubles, and 0.8 s at 5 MS/s."""

MIN_CENTRES = 8
"""Fewest values of the centre from which its motion is stated."""


def describe_centre_motion(
    recording: Recording, device: Device, motion: Motion, grid: Grid, max_pixels: float
) -> list[str]:
    """A line for each axis whose centre moves in the position signal by more than ``max_pixels``, but for the drive.

    A mirror at resonance moves about its rest position, which only a slow torque displaces: what a recorded drive does
    not cause is an error of the sensor, and the estimator ``sensor`` maps it. An axis without a recorded drive, or
    whose device states no mechanics, is not checked.

    Args:
        recording, device: of the scan.
        motion: with the estimator's name; its angles are measured ones for ``sensor``.
        grid: the pixels.
        max_pixels: amplitude from which it is stated [px].
    """
    if motion.estimator != "sensor":
        return []
    lines = []
    for name, half_angle, pixels in (("x", grid.half_angle_x, grid.width), ("y", grid.half_angle_y, grid.height)):
        time, centre, noise_sd = _undriven_centre(recording, device.axis(name), motion, name)
        if centre.size < MIN_CENTRES:
            continue
        centre = centre - centre.mean()
        variance = max(float(centre.var()) - noise_sd**2, 0.0)
        amplitude = sqrt(2.0 * variance) * pixels / (2.0 * half_angle)
        if amplitude <= max_pixels:
            continue
        spectrum = np.abs(np.fft.rfft(centre))
        frequency = float(np.argmax(spectrum) / (centre.size * np.mean(np.diff(time))))
        lines.append(
            f"{name}: the centre of the motion moves by ±{amplitude:.2g} pixels, most at {frequency:.3g} Hz, which its "
            "drive does not cause: hum or drift of the sensor, which the estimator sensor takes for motion, so that "
            "the picture is distorted; remove the hum, or use --estimator tracker"
        )
    return lines


def _undriven_centre(recording: Recording, axis: Axis, motion: Motion, name: str) -> tuple[Array, Array, float]:
    """Times [s] and centre of the motion less what the drive's slow part causes [rad], and the standard deviation of
    the centre by white noise [rad]; empty where the drive's part is unknown."""
    drive, track = recording.channels.get(f"drive_{name}"), motion.axes[name]
    nothing = np.empty(0), np.empty(0), 0.0
    frequency = float(np.median(track.frequency))
    if drive is None or axis.drive is None or axis.mechanics is None or track.reference not in ("drive", "half-drive"):
        return nothing
    if frequency < MIN_RELATIVE_FREQUENCY * axis.resonance:  # the drive moves it slowly
        return nothing
    rate, values = track.angle.sample_rate, track.angle.read(0, min(track.angle.size, MAX_READ_SAMPLES))
    time, centre = _centres(values, rate, track.angle.start, frequency)
    if axis.drive.kind == "linear":
        volts = _centres(drive.read(0, MAX_READ_SAMPLES), drive.sample_rate, drive.start, frequency)
        if axis.drive.torque_per_volt is None or volts[1].size < MIN_CENTRES:
            return nothing
        centre -= axis.drive.torque_per_volt / axis.mechanics.k * np.interp(time, *volts)
    known = np.isfinite(centre)
    return time[known], centre[known], white_noise_sd(values) * float(np.linalg.norm(_window(rate, frequency)))


def _centres(values: Array, rate: float, start: float, frequency: float) -> tuple[Array, Array]:
    """Times [s] and means of an oscillation without its period, one value a period.

    Each is weighted by a Hann window of two periods, which cancels a sine of the period and its harmonics, also where
    the amplitude changes.
    """
    window = _window(rate, frequency)
    length = window.size // 2
    finite = np.where(np.isfinite(values), values, np.nan)
    periods = finite[: values.size // length * length].reshape(-1, length)
    means = np.asarray(periods[:-1] @ window[:length] + periods[1:] @ window[length:], np.float64)
    return np.asarray(start + np.arange(1, means.size + 1) * length / rate, np.float64), means


def _window(rate: float, frequency: float) -> Array:
    """A Hann window of two periods, of sum 1."""
    length = max(2, round(rate / frequency))
    return np.asarray(np.hanning(2 * length + 1)[:-1] / length, np.float64)
