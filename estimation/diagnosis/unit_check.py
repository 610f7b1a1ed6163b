"""Whether a channel has the unit and the sign that it states, by the motion that the nominal device gives.

A wrong device gives another waveform. A wrong unit, of the channel or of its drive, gives the same one at another size,
and the wrong sign gives it inverted. Without this check the fit finds a law that scales the motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from estimation.device_fit.data import Run
from estimation.device_fit.drive_lines import is_steady, strongest_line
from estimation.device_fit.model import Model
from scanner.arrays import Array
from scanner.device import Device
from scanner.errors import BadInput
from scanner.forward_model import DriveInput
from scanner.recording import Recording

MIN_CORRELATION_SQUARE = 0.9
"""Share of a channel's variance that a multiple of the predicted signal explains, above which the waveform is that of
the device."""

MAX_FACTOR = 30.0
"""Factor, or its reciprocal, above which a unit is wrong: degrees are 57 times smaller than radians, milliradians and
millivolts a thousand times. Quality factors, to which a resonance is proportional, are known to a factor of a few."""


class Comparison(NamedTuple):
    """The multiple of a predicted signal that is nearest to a channel, and the share of the variance it explains."""

    factor: float
    correlation_square: float


def check_units_and_signs(recordings: Sequence[Recording], runs: Sequence[Run], device: Device) -> None:
    """Check every driven channel against the motion that the nominal device gives from rest.

    The second half of a recording is compared, in which the initial state has mostly decayed. A steady tone beside a
    resonance inverts the motion where the resonance lies on its other side, so that it shows no sign.

    Raises:
        BadInput: a channel has the waveform of the prediction, inverted or at a size that another unit explains.
    """
    for recording, run in zip(recordings, runs, strict=True):
        model = Model([run], device, mains=())
        signals = model.outputs(np.zeros(len(model.parameters)))[0]
        for output, signal in zip(run.outputs, signals, strict=True):
            found = compare(output.data, signal)
            if found is None or found.correlation_square < MIN_CORRELATION_SQUARE:
                continue
            what = f"has the waveform that the device gives, times {found.factor:.3g}"
            is_tone = any(_is_steady_tone(run.inputs[axis]) for axis in output.axes)
            most = MAX_FACTOR * (max(_resonance_in_widths(device, axis) for axis in output.axes) if is_tone else 1.0)
            if not 1.0 / most < abs(found.factor) < most:
                hint = "check the unit and the gain of this channel, and the unit of the drive"
                raise BadInput(what, file=recording.path, channel=output.name, hint=hint)
            if found.factor < 0.0 and not is_tone:
                hint = "check the sign of this channel, of its gain, and of the drive"
                raise BadInput(what, file=recording.path, channel=output.name, hint=hint)


def _resonance_in_widths(device: Device, axis: str) -> float:
    """Uncertainty of a resonance in its own widths, 1 at least: by this factor the response to a tone is unknown."""
    tolerance = max(device.tolerance(axis, key) for key in ("J", "k"))
    return max(1.0, tolerance * device.axis(axis).quality)


def compare(data: Array, signal: Array) -> Comparison | None:
    """Compare the second half of a channel with a prediction, shape (n,) each; None where one of them is constant."""
    finite = np.isfinite(data) & np.isfinite(signal)
    finite[: data.size // 2] = False
    if not finite.any():
        return None
    measured, predicted = (each[finite] / max(float(np.abs(each[finite]).max()), 1e-300) for each in (data, signal))
    measured, predicted = measured - measured.mean(), predicted - predicted.mean()
    power, common, total = predicted @ predicted, predicted @ measured, measured @ measured
    if not (power > 0.0 and total > 0.0):
        return None
    scale = float(np.abs(data[finite]).max() / max(float(np.abs(signal[finite]).max()), 1e-300))
    return Comparison(float(common / power) * scale, float(common**2 / (power * total)))


def _is_steady_tone(drive: DriveInput) -> bool:
    """Whether a drive is a steady tone with its harmonics."""
    rate = 1.0 / drive.step
    return is_steady(strongest_line(drive.samples, rate), drive.samples, rate)
