"""From a recording to its motion, by any estimator of the catalogue and for a device with or without terms."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from estimation.estimators import find_estimator
from estimation.signals import require_device
from scanner.device import Device
from scanner.errors import BadInput
from scanner.motion import Motion
from scanner.recording import Recording
from scanner.stages import Position


def default_estimator(recording: Recording, device: Device) -> str:
    """Name of the estimator that suits the channels of a recording.

    Returns:
        ``"tracker"`` with a capacitive readout or a sensor of velocity or acceleration; ``"edges"`` with edges
        and neither sense nor angle channel; ``"picture"`` with an intensity and the drives or their frequencies and
        none of these; otherwise ``"sensor"``.
    """
    followed = any(
        f"sense_{name}" in recording and axis.readout is not None and not isinstance(axis.readout, Position)
        for name, axis in device.axes.items()
    )
    unmeasured = [axis for axis in device.axes if not any(f"{kind}_{axis}" in recording for kind in ("sense", "angle"))]
    derivative = any(f"{kind}_{axis}" in recording for axis in unmeasured for kind in ("velocity", "acceleration"))
    if "sense" in recording or followed or derivative:
        return "tracker"
    crossed = [name.partition("_")[2] for name in recording.edges]
    if crossed and not any(f"{kind}_{axis}" in recording for axis in crossed for kind in ("sense", "angle")):
        return "edges"
    driven = "intensity" in recording and all(
        f"drive_{name}" in recording or (axis.drive is not None and axis.drive.frequency is not None)
        for name, axis in device.axes.items()
    )
    kinds = ("sense", "angle", "amplitude")
    measured = any(f"{kind}_{axis}" in recording for axis in device.axes for kind in kinds)
    return "picture" if driven and not measured else "sensor"


def estimate(
    recording: Recording,
    device: Device | None = None,
    method: str | None = None,
    flips: Mapping[str, bool] | None = None,
    before: Motion | None = None,
) -> Motion:
    """The motion of every axis of the device.

    Args:
        recording: with the channels that the estimator needs.
        device: replaces the recording's own.
        method: name of an estimator (``estimation.estimators``); ``default_estimator`` without it.
        flips: axes whose sign is to be reversed: an even capacitance does not distinguish theta from -theta.
        before: motion of an earlier segment of the same scan, from which an estimator that can ``resume`` continues.

    Raises:
        BadInput: no such estimator, or it cannot use the recording or the device.
    """
    from estimation.signs import resolve_signs
    from estimation.term_compensation import estimate_with_terms

    device = require_device(recording, device)
    estimator = find_estimator(method or default_estimator(recording, device))

    def run(recording: Recording, device: Device) -> Motion:
        if before is not None and estimator.resume is not None:
            motion = estimator.resume(recording, device, before)
        else:
            motion = estimator.run(recording, device)
        check_finite(motion, recording)
        return resolve_signs(motion, recording, flips or {})

    return estimate_with_terms(recording, device, run, estimator.is_model_based, estimator.treats_clipping)


def check_finite(motion: Motion, recording: Recording) -> None:
    """Check that an estimator could follow the signals.

    Raises:
        BadInput: the phase or the amplitude of an axis is not finite.
    """
    for name, axis in motion.axes.items():
        if np.isfinite(axis.phase).all() and np.isfinite(axis.amplitude).all():
            continue
        what = f"the estimator {motion.estimator} diverges: the signal of {name} does not fit the device"
        hint = f"check units, the gain of [{name}.readout], and [{name}.mechanics]"
        raise BadInput(what, file=recording.path, channel=name, hint=hint)
