"""What a calibration recording shows of one axis: rest, a free decay or driven motion, with or without a reference."""

from __future__ import annotations

import numpy as np

from scanner.arrays import Array
from scanner.recording import Recording
from scanner.signal_check import check_signal

UNREFERENCED_DECAY = "free decay without a reference angle"
UNREFERENCED_DRIVE = "driven motion without a reference angle"

MIN_DRIVE_VARIATION = 1e-3
"""Standard deviation of a drive relative to its largest value below which it counts as constant."""

WHITE_NOISE_MARGIN = 1.2
"""Standard deviation of a signal over that of white noise with the same differences or the same median of the spectrum,
above which it shows motion."""


def classify_recording(recording: Recording, name: str) -> str | None:
    """What a recording shows of one axis; None if nothing is of use.

    ``"rest"``, ``"free decay"`` or ``"driven"`` with a reference, or ``UNREFERENCED_DECAY`` or ``UNREFERENCED_DRIVE``.
    A reference is the angle, the velocity, the acceleration, or amplitude and phase of a lock-in amplifier.

    Raises:
        BadInput: a sample of the drive, of a reference, or of a sense signal without a reference, is not finite.
    """
    drive, sense = (recording.channels.get(f"{kind}_{name}") for kind in ("drive", "sense"))
    oscillates = False
    if drive is not None:
        check_signal(drive, constant_ok=True)
        values = drive.read()
        oscillates = bool(np.std(values) > MIN_DRIVE_VARIATION * max(np.abs(values).max(), 1e-300))
    if lock_in_only(recording, name):
        return "driven" if oscillates else "free decay"
    for kind in ("angle", "velocity", "acceleration"):
        reference = recording.channels.get(f"{kind}_{name}")
        if reference is None:
            continue
        check_signal(reference, constant_ok=True)
        if shows_motion(reference.read()):
            return "driven" if oscillates else "free decay"
    if sense is None:
        return None
    check_signal(sense)
    moves = shows_motion(sense.read())
    if oscillates:
        return UNREFERENCED_DRIVE if moves else None
    return UNREFERENCED_DECAY if moves else "rest"


def lock_in_only(recording: Recording, name: str) -> bool:
    """Whether amplitude and phase of a lock-in amplifier are the only reference of an axis."""
    references = [f"{kind}_{name}" in recording for kind in ("angle", "velocity", "acceleration")]
    return not any(references) and all(f"{kind}_{name}" in recording for kind in ("amplitude", "phase"))


def shows_motion(values: Array) -> bool:
    """Whether a signal is more than white noise: neighbouring samples of noise differ as much as distant ones.

    With less than five samples a period those of a motion do so too, and a line in the spectrum shows it: the power of
    white noise is distributed exponentially, with a median of ln 2 times its mean.
    """
    if np.std(values) > WHITE_NOISE_MARGIN * np.std(np.diff(values)) / np.sqrt(2.0):
        return True
    power = np.abs(np.fft.rfft(values - np.mean(values))[1:]) ** 2
    return bool(np.mean(power) > WHITE_NOISE_MARGIN**2 * np.median(power) / np.log(2.0))
