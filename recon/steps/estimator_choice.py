"""The estimator of a recording for which none was asked: by its channels, and by the noise of its position sensors."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress

import numpy as np

from estimation.estimate import default_estimator, estimate
from estimation.signals import robust_sd
from recon.imaging.blur import SHARP_FRACTION, within_bound
from recon.imaging.picture import Grid, grid_of_scan
from recon.steps.preparation import PreparedRecording
from recon.steps.reconstruction import Options
from scanner.device import AXES, Device
from scanner.errors import BadInput
from scanner.motion import Motion
from scanner.recording import Recording

TRIED_S = 1.0
"""Duration from the start of a scan with which the estimators are tried: hundreds of periods of a resonant mirror."""

MIN_TRIED_PERIODS = 20.0
"""Periods of either axis in this duration; in fewer, the motion of a start from rest may be all there is."""

COMPARED_SAMPLES = 1 << 18
"""Samples from the start of the scan in which two motions are compared: 50 ms at 5 MS/s."""


def choose_estimator(prepared: PreparedRecording, options: Options) -> tuple[str, list[str]]:
    """Return the estimator with the smaller expected error, and a line if the sensors' noise decided.

    The channels decide first (``estimation.estimate.default_estimator``). ``sensor`` takes every sample as it was
    measured. Where that noise alone moves samples too far for a sharp picture, and the device has a model of the motion
    whose error is smaller than the noise, ``tracker`` is used.

    Args:
        prepared: the recording.
        options: pixels and tolerance of the picture.
    """
    recording, device = prepared.recording, prepared.device
    name = default_estimator(recording, device)
    if name != "sensor" or device.scan is None:
        return name, []
    grid = grid_of_scan(*options.pixels, device.scan)
    recording, sensed = _sense_beginning(recording, device)
    noise = sample_noise_px(sensed, grid)
    if min(within_bound(options.p, sd=np.array([sd])) for sd in noise.values()) >= SHARP_FRACTION:
        return "sensor", []
    try:
        tracked = estimate(recording, device, "tracker")
    except BadInput:  # no model of the motion, or none that fits
        return "sensor", []
    if any(model_error_px(sensed, tracked, grid)[axis] >= noise[axis] for axis in AXES):
        return "sensor", []
    sizes = " and ".join(f"{sd:.2g} pixels in {axis}" for axis, sd in noise.items())
    note = (
        f"the noise of the position signals moves single samples by {sizes} (1 sd). The tracker was used, which "
        "follows the motion through the noise; --estimator sensor takes the samples as they are"
    )
    return "tracker", [note]


def _sense_beginning(recording: Recording, device: Device) -> tuple[Recording, Motion]:
    """The first ``TRIED_S`` of a recording, and the motion from its sensors; of all of it where that is too short."""
    if recording.duration > TRIED_S:
        with suppress(BadInput):
            beginning = recording.part(recording.start, recording.start + TRIED_S)
            sensed = estimate(beginning, device, "sensor")
            if TRIED_S * min(float(np.median(axis.frequency)) for axis in sensed.axes.values()) >= MIN_TRIED_PERIODS:
                return beginning, sensed
    return recording, estimate(recording, device, "sensor")


def sample_noise_px(motion: Motion, grid: Grid) -> Mapping[str, float]:
    """Standard deviation of the noise in single samples of the angle, by axis [px]."""
    return {axis: motion.axes[axis].angle_noise_sd / pixel for axis, pixel in zip(AXES, grid.pixel_angle, strict=True)}


def model_error_px(sensed: Motion, tracked: Motion, grid: Grid) -> Mapping[str, float]:
    """Error of a motion that follows a model, from its difference from the samples without their noise, by axis [px].

    Args:
        sensed: with the noise of the samples.
        tracked: without it.
        grid: the pixels.
    """
    errors = {}
    for axis, pixel in zip(AXES, grid.pixel_angle, strict=True):
        angles = (motion.axes[axis].angle.read(0, COMPARED_SAMPLES) for motion in (sensed, tracked))
        difference = np.subtract(*angles)
        variance = robust_sd(difference) ** 2 - sensed.axes[axis].angle_noise_sd ** 2
        errors[axis] = float(np.sqrt(max(variance, 0.0))) / pixel
    return errors
