"""Uncertainty of the amplitude that comes from the calibration of the readout, and scales the whole picture."""

from __future__ import annotations

from math import hypot

import numpy as np

from scanner.device import Device
from scanner.harmonics import capacitance_harmonics
from scanner.motion import Motion
from scanner.recording import Recording
from scanner.stages import Amdm, Capacitance, MotionSensor, Transimpedance

MODEL_FREE_ESTIMATORS = ("picture",)
"""Estimators that use no readout: the recording does not calibrate their amplitude."""

RELATIVE_STEP = 1e-3
"""Relative change of the amplitude for the derivative of the signal by it."""


def amplitude_calibration_sd(
    recording: Recording, device: Device, axis: str, amplitude: float, estimator: str
) -> float | None:
    """Relative standard deviation of an amplitude by the stated tolerances of its readout, to first order.

    A capacitive signal is its second harmonic, S(A): relative errors of its gain change A by S / (A S') times as much,
    and one of theta0 changes A by as much. The mechanics, which may narrow this, are not considered.

    Args:
        recording, device: of the scan.
        axis: its name.
        amplitude: [rad].
        estimator: name of the estimator that found it.

    Returns:
        0 with an angle channel; None where nothing calibrates the amplitude.
    """
    if estimator in MODEL_FREE_ESTIMATORS:
        return None
    sensed = device.sensed_axis(axis)
    readout = sensed.readout
    has_sense = "sense" in recording or f"sense_{axis}" in recording
    if f"angle_{axis}" in recording and not (has_sense and isinstance(readout, (Amdm, Transimpedance))):
        return 0.0
    if isinstance(readout, MotionSensor):
        return device.tolerance(axis, "gain")
    if readout is None or sensed.capacitance is None:
        return None
    return hypot(amplitude_sd_by_gain(device, axis, amplitude), device.tolerance(axis, "theta0"))


def amplitude_sd_by_gain(device: Device, axis: str, amplitude: float) -> float:
    """Relative standard deviation of an amplitude by the tolerances of the gains of a capacitive signal.

    Args:
        device: with a comb and a capacitive readout of this axis.
        axis: its name.
        amplitude: [rad].
    """
    sensed = device.sensed_axis(axis)
    assert sensed.capacitance is not None
    gains = ("a_cir",) if isinstance(sensed.readout, Amdm) else ("R_s", "V_bias")
    gain_sd = hypot(device.tolerance(axis, "C0"), *(device.tolerance(axis, key) for key in gains))
    steps = amplitude * (1.0 + np.array([-RELATIVE_STEP, RELATIVE_STEP]))
    behind, ahead = (np.log(_second_harmonic(float(each), sensed.capacitance)) for each in steps)
    slope = max(abs(float(ahead - behind)) / (2 * RELATIVE_STEP), RELATIVE_STEP)  # d ln S / d ln A
    return gain_sd / slope


def motion_calibration_sd(recording: Recording, device: Device, axis: str, motion: Motion) -> float | None:
    """Relative standard deviation of the amplitude of an estimated motion by the calibration.

    Args:
        recording, device: of the scan.
        axis: its name.
        motion: of all axes.

    Returns:
        As :func:`amplitude_calibration_sd`. Of an axis with edges, which use no readout: 0 where the stated angle of
        the detector determines the amplitude, because this angle has no tolerance; None where nothing does.
    """
    own = motion.axes[axis]
    if motion.estimator == "edges" and f"sync_{axis}" in recording.edges:
        return None if own.amplitude_sd is None else 0.0
    return amplitude_calibration_sd(recording, device, axis, float(np.mean(own.amplitude)), motion.estimator)


def _second_harmonic(amplitude: float, comb: Capacitance) -> float:
    return float(abs(capacitance_harmonics(amplitude, comb)[2]))
