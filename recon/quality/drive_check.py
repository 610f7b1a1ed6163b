"""Whether the drives fit the device: swapped drives and wrong sample rates are named before anything is estimated."""

from __future__ import annotations

from math import isclose

from estimation.reference import dominant_frequency
from scanner.device import AXES, Device
from scanner.errors import BadInput
from scanner.recording import Recording

SAME_FREQUENCY = 0.05
"""Relative difference up to which a frequency counts as a resonance of the device, or two ratios as equal."""

MIN_SEARCHED_RATIO = 1e-4
"""Frequency over the resonance from which a drive is looked for: a rate in kHz in place of Hz is 1e-3."""

MAX_DRIVE_RATIO = 1.33
"""Factor between drive and resonance from which both axes together show a wrong sample rate."""


def check_drives(recording: Recording, device: Device) -> None:
    """Check the frequencies of both drives against the resonances of the device.

    One axis that is driven off its resonance is no error. Two that are off by one factor, or at each other's
    resonance, are.

    Raises:
        BadInput: drives that are swapped, or a sample rate off by the factor that the message states.
    """
    moved, resonance = {}, {}
    for name in AXES:
        axis, key = device.axis(name), f"drive_{name}"
        if axis.mechanics is None or axis.drive is None or key not in recording:
            return
        try:
            frequency = dominant_frequency(recording[key], MIN_SEARCHED_RATIO * axis.resonance)
        except BadInput:  # no oscillation: the estimator says what it needs
            return
        moved[name], resonance[name] = frequency * axis.drive.motion_per_drive, axis.resonance
    if isclose(resonance["x"], resonance["y"], rel_tol=SAME_FREQUENCY):
        return
    at = ", ".join(f"{name} at {moved[name]:.6g} Hz (resonance {resonance[name]:.6g} Hz)" for name in AXES)
    file = recording["drive_x"].file
    crossed = ((moved["x"], resonance["y"]), (moved["y"], resonance["x"]))
    if all(isclose(f, other, rel_tol=SAME_FREQUENCY) for f, other in crossed):
        what = f"and drive_y are swapped: they move {at}"
        raise BadInput(what, file=file, channel="drive_x", hint="exchange the channels, or the axes of the device")
    ratio = {name: moved[name] / resonance[name] for name in AXES}
    wrong = max(ratio["x"], 1 / ratio["x"]) > MAX_DRIVE_RATIO
    if wrong and isclose(ratio["x"], ratio["y"], rel_tol=SAME_FREQUENCY):
        what = f"and drive_y move {at}, as if the sample rate were {ratio['x']:.3g} times the true one"
        hint = "check sample_rate, and J and k of the device"
        if isclose(ratio["x"], 2.0, rel_tol=SAME_FREQUENCY) or isclose(ratio["x"], 0.5, rel_tol=SAME_FREQUENCY):
            hint += "; combs (kind electrostatic) move the mirror at half the drive's frequency"
        raise BadInput(what, file=file, channel="drive_x", hint=hint)
