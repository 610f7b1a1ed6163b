"""Recordings whose motion persists although the drive that keeps it up was not recorded: no model predicts them."""

from __future__ import annotations

from math import ceil

import numpy as np

from estimation.device_fit.data import output_channels
from scanner.arrays import Array
from scanner.device import Device
from scanner.recording import Recording

MIN_EXPECTED_DECAY = 1.0
"""Natural logarithm by which a free motion of the device decays within a recording from which a steady one is refused.
Quality factors of a device file are known to a factor of a few."""

MAX_STEADY_CHANGE = 0.9
"""Amplitude at the end over that at the beginning from which a motion counts as steady, and the reciprocal of the ratio
from which it counts as growing."""

LINE_WIDTH_BINS = 2
"""Frequency bins on either side of a line that contain it, with a Hann window."""

PARTS = 10
"""Number of parts of a recording whose amplitudes are compared."""


def steady_without_drive(recording: Recording, device: Device) -> str | None:
    """What is wrong with a recording whose motion persists without a drive of its axes; None if nothing is.

    A drive that was recorded and is constant keeps up no motion either. Under it, the amplitude falls from the
    beginning to the end, and does not grow after a time in which a free motion of the device decays.
    """
    for name, (_, axes) in output_channels(recording, device).items():
        recorded = [f"{kind}_{axis}" for axis in axes for kind in ("drive", "bias") if f"{kind}_{axis}" in recording]
        if any(np.ptp(recording[drive].read()) != 0.0 for drive in recorded):
            continue
        channel = recording[name]
        rates = [np.pi * device.axis(axis).resonance / device.axis(axis).quality for axis in axes]
        decay = min(rates) * channel.size / channel.sample_rate
        if decay < MIN_EXPECTED_DECAY:
            continue
        part, lag = channel.size // PARTS, min(ceil(PARTS * MIN_EXPECTED_DECAY / decay), PARTS - 1)
        amplitudes = np.array([_tone_amplitude(channel.read(i * part, (i + 1) * part)) for i in range(PARTS)])
        steady = amplitudes[-1] > MAX_STEADY_CHANGE * amplitudes[0] > 0.0
        before = np.maximum.accumulate(amplitudes)[:-lag]
        grows = np.any((MAX_STEADY_CHANGE * amplitudes[lag:] > before) & (before > 0.0))
        if recorded and (steady or grows):
            return f"{name} moves steadily or grows under a constant {' and '.join(recorded)}"
        if steady:
            return f"{name} moves steadily without {' and '.join(f'drive_{axis}' for axis in axes)}"
    return None


def axes_without_drive(recording: Recording, device: Device) -> list[str]:
    """The axes of the measured channels of which neither drive nor bias was recorded."""
    measured = sorted({axis for _, axes in output_channels(recording, device).values() for axis in axes})
    return [axis for axis in measured if not {f"drive_{axis}", f"bias_{axis}"} & recording.channels.keys()]


def _tone_amplitude(values: Array) -> float:
    """Amplitude of the strongest line of some samples, up to a constant; 0 if it has less than half of the power."""
    values = values[np.isfinite(values)]
    if values.size < 2:
        return 0.0
    power = np.abs(np.fft.rfft((values - values.mean()) * np.hanning(values.size))) ** 2
    peak = int(np.argmax(power))
    line = power[max(peak - LINE_WIDTH_BINS, 0) : peak + LINE_WIDTH_BINS + 1].sum()
    return float(np.sqrt(line)) if line > 0.5 * power.sum() else 0.0
