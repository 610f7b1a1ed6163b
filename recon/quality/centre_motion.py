"""Whether a position signal of a resonant motion holds more than this motion: crosstalk, hum or drift of the sensor."""

from __future__ import annotations

from math import sqrt

import numpy as np

from estimation.sensor_hum import MIN_CENTRES, is_slow_drive_known, mean_window, means_over_periods, slow_drive_angle
from estimation.signals import white_noise_sd
from recon.imaging.picture import Grid
from scanner.arrays import Array
from scanner.device import AXES, Axis, Device
from scanner.motion import Motion
from scanner.recording import Recording

MAX_READ_SAMPLES = 1 << 22
"""Samples from the start in which the centre is measured: 32 MB of doubles, and 0.8 s at 5 MS/s."""

MIN_BEATS = 10.0
"""Beats of the frequencies of both axes, and periods of the other axis, in a block in which crosstalk is measured: the
side lobes of a Hann window are then below 1e-3 and differ in sign from block to block, so that neither the own motion
nor a constant counts as the other one's."""


def describe_centre_motion(
    recording: Recording, device: Device, motion: Motion, grid: Grid, max_pixels: float
) -> list[str]:
    """A line for each axis whose position signal follows the other axis, or whose centre moves without a cause in the
    drive, by more than ``max_pixels``.

    A mirror at resonance moves about its rest position, which only a slow torque displaces: what a recorded drive does
    not cause is an error of the sensor, and the estimator ``sensor`` maps it. What follows the other axis is crosstalk.
    An axis without a recorded drive, or whose device states no mechanics, is not checked.

    Args:
        recording, device: of the scan.
        motion: with the estimator's name; its angles are measured ones for ``sensor``.
        grid: the pixels.
        max_pixels: amplitude from which it is stated [px].
    """
    if motion.estimator != "sensor":
        return []
    lines, factors = [], {name: _crosstalk(motion, name) for name in AXES}
    for name, half_angle, pixels in (("x", grid.half_angle_x, grid.width), ("y", grid.half_angle_y, grid.height)):
        time, centre, noise_sd = _undriven_centre(recording, device.axis(name), motion, name, factors[name])
        if centre.size < MIN_CENTRES:
            continue
        other = _other(name)
        shear = abs(factors[name]) * float(motion.axes[other].amplitude.max()) * pixels / (2.0 * half_angle)
        if shear > max_pixels:
            lines.append(
                f"{name}: the position signal follows {other} by the factor {factors[name]:+.2g}, ±{shear:.2g} pixels: "
                f"crosstalk, a sensor that is rotated against the axes, or a mirror that itself follows {other}. If it "
                "is not the mirror, the estimator sensor maps it as motion and the picture is sheared: "
                f"state it under [{name}.terms.sensor-crosstalk] in the device, as diagnose measures it, or use "
                "--estimator tracker"
            )
        centre = centre - centre.mean()
        variance = max(float(centre.var()) - noise_sd**2, 0.0)
        amplitude = sqrt(2.0 * variance) * pixels / (2.0 * half_angle)
        if amplitude <= max_pixels:
            continue
        spectrum = np.abs(np.fft.rfft(centre))
        frequency = float(np.argmax(spectrum) / (centre.size * np.mean(np.diff(time))))
        lines.append(
            f"{name}: the centre of the motion moves by ±{amplitude:.2g} pixels, most at {frequency:.3g} Hz, which its "
            "drive does not cause: hum or drift of the sensor, which the estimator sensor maps as motion, so that "
            "the picture is distorted; remove the hum, or use --estimator tracker"
        )
    return lines


def _other(name: str) -> str:
    """The other axis."""
    return AXES[1 - AXES.index(name)]


def _angles(motion: Motion, name: str) -> Array:
    """Angles of one axis, of the first ``MAX_READ_SAMPLES`` [rad]."""
    angle = motion.axes[name].angle
    return angle.read(0, min(angle.size, MAX_READ_SAMPLES))


def _crosstalk(motion: Motion, name: str) -> float:
    """Factor by which the measured angle of an axis follows the other one at the frequency of that; 0 where the
    recording is too short to separate this frequency from the own one, or from a constant.

    The factor is the in-phase part of the ratio of both phasors, in blocks within which the frequencies hardly drift.
    """
    frequencies = [float(np.median(motion.axes[each].frequency)) for each in (name, _other(name))]
    rate, beat = motion.axes[name].angle.sample_rate, min(abs(frequencies[0] - frequencies[1]), frequencies[1])
    values = np.stack([_angles(motion, name), _angles(motion, _other(name))])
    size = values.shape[1]
    if beat * size < MIN_BEATS * rate:
        return 0.0
    count = int(beat * size / (MIN_BEATS * rate))
    length = size // count
    turn = np.exp(-2j * np.pi * frequencies[1] / rate * np.arange(length)) * np.hanning(length)
    blocks = values[:, : count * length].reshape(2, count, length)
    own, other = (blocks - blocks.mean(axis=2, keepdims=True)) @ turn
    known = np.isfinite(own) & np.isfinite(other)
    power = float(np.sum(np.abs(other[known]) ** 2))
    return float(np.sum((own * other.conj())[known].real)) / power if power > 0.0 else 0.0


def _undriven_centre(
    recording: Recording, axis: Axis, motion: Motion, name: str, factor: float
) -> tuple[Array, Array, float]:
    """Times [s] and centre of the motion less what the drive's slow part causes and ``factor`` times the other axis
    [rad], and the standard deviation of the centre by white noise [rad]; empty where the drive's part is unknown."""
    track = motion.axes[name]
    nothing = np.empty(0), np.empty(0), 0.0
    if not is_slow_drive_known(recording, axis, name, track):
        return nothing
    frequency = float(np.median(track.frequency))
    rate, values = track.angle.sample_rate, _angles(motion, name) - factor * _angles(motion, _other(name))
    time, centre = means_over_periods(values, rate, track.angle.start, frequency)
    if axis.drive is not None and axis.drive.kind == "linear":
        driven = slow_drive_angle(axis, recording[f"drive_{name}"], (0, MAX_READ_SAMPLES), frequency, time)
        if driven is None:
            return nothing
        centre -= driven
    known = np.isfinite(centre)
    return time[known], centre[known], white_noise_sd(values) * float(np.linalg.norm(mean_window(rate, frequency)))
