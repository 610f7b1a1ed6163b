"""Whether the size and the shape of a capacitive signal agree with the amplitude that was estimated from it."""

from __future__ import annotations

from collections.abc import Mapping
from math import hypot

from estimation.amplitude_calibration import MODEL_FREE_ESTIMATORS, motion_calibration_sd
from estimation.estimators import find_estimator
from estimation.harmonic_amplitude import AmplitudeCheck, check_amplitudes
from scanner.device import Device
from scanner.motion import Motion
from scanner.recording import Recording


def compare_with_signal(recording: Recording, device: Device, motion: Motion) -> Mapping[str, AmplitudeCheck]:
    """As :func:`estimation.harmonic_amplitude.check_amplitudes`; empty if another signal gave the motion."""
    is_sensed = "sense" in recording or all(f"sense_{name}" in recording for name in device.axes)
    from_sense = motion.estimator not in MODEL_FREE_ESTIMATORS and find_estimator(motion.estimator).is_model_based
    if not is_sensed or not from_sense:
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
