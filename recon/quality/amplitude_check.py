"""Whether the size and the shape of a capacitive signal agree with the amplitude that was estimated from it."""

from __future__ import annotations

from collections.abc import Mapping
from math import hypot

from estimation.amplitude_calibration import MODEL_FREE_ESTIMATORS, motion_calibration_sd
from estimation.estimators import find_estimator
from estimation.harmonic_amplitude import AmplitudeCheck, check_amplitudes, relative_signal_sizes
from scanner.device import Device
from scanner.errors import BadInput
from scanner.motion import Motion
from scanner.recording import Recording

MAX_RELATIVE_SIGNAL = 30.0
"""Size of a capacitive signal over the largest that the device gives at any amplitude, above which its unit is wrong:
units differ by a thousand, and a gain that is wrong by less is found by :func:`compare_with_signal`."""


def check_signal_units(recording: Recording, device: Device, motion: Motion) -> None:
    """Check that a capacitive signal has the unit that its channel states.

    A smaller signal is accepted: drive and picture determine the motion beside a sensor that hardly responds.

    Raises:
        BadInput: a signal is far larger than the device gives.
    """
    if not _is_from_sense(recording, device, motion):
        return
    for name, size in relative_signal_sizes(recording, device, motion).items():
        if size > MAX_RELATIVE_SIGNAL:
            what = f"the signal of {name} is {size:.0f} times the largest that the device gives"
            hint = f"check units, the gain of [{name}.readout], and C0 of [{name}.capacitance]"
            raise BadInput(what, file=recording.path, channel=name, hint=hint)


def _is_from_sense(recording: Recording, device: Device, motion: Motion) -> bool:
    """Whether the motion was estimated from sense signals through a model of the device."""
    is_sensed = "sense" in recording or all(f"sense_{name}" in recording for name in device.axes)
    return (
        is_sensed and motion.estimator not in MODEL_FREE_ESTIMATORS and find_estimator(motion.estimator).is_model_based
    )


def compare_with_signal(recording: Recording, device: Device, motion: Motion) -> Mapping[str, AmplitudeCheck]:
    """As :func:`estimation.harmonic_amplitude.check_amplitudes`; empty if another signal gave the motion."""
    if not _is_from_sense(recording, device, motion):
        return {}
    return check_amplitudes(recording, device, motion)


def amplitude_calibration(
    recording: Recording, device: Device, motion: Motion, checks: Mapping[str, AmplitudeCheck]
) -> dict[str, float | None]:
    """Relative standard deviation of every amplitude by the stated tolerances and by what contradicts them.

    Returns:
        By axis; None where nothing calibrates the amplitude.
    """
    stated = {name: motion_calibration_sd(recording, device, name, motion) for name in motion.axes}
    return {
        name: hypot(sd, checks[name].error_sd) if sd is not None and name in checks else sd
        for name, sd in stated.items()
    }


def describe_amplitude_contradictions(checks: Mapping[str, AmplitudeCheck]) -> list[str]:
    """A line for every axis whose signal contradicts the device at the estimated amplitude."""
    lines = []
    for name, check in checks.items():
        if not check.error_sd:
            continue
        lines.append(
            f"{name}: the sense signal contradicts the device: at the estimated amplitude its second harmonic is "
            f"{check.size.ratio:.3g} times what the device gives, and the ratio of the fourth to the second "
            f"{check.shape.ratio:.3g} times, "
            "more than the stated tolerances allow; the amplitude, and with it the scale of the picture, may be wrong "
            f"by {100 * check.error_sd:.2g} %. Check C0, theta0 and the gain of the readout, and whether the drive "
            "feeds through (diagnose)"
        )
    return lines
