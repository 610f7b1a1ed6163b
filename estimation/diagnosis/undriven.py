"""Recordings whose motion persists although the drive that keeps it up was not recorded: no model predicts them."""

from __future__ import annotations

import numpy as np

from estimation.device_fit.data import output_channels
from scanner.arrays import Array
from scanner.device import Device
from scanner.recording import Recording

MIN_EXPECTED_DECAY = 1.0
"""Natural logarithm by which a free motion of the device decays within a recording from which a steady one is refused.
Quality factors of a device file are known to a factor of a few."""

MAX_STEADY_CHANGE = 0.9
"""Amplitude at the end over that at the beginning from which a motion counts as steady."""

LINE_WIDTH_BINS = 2
"""Frequency bins on either side of a line that contain it, with a Hann window."""


def steady_without_drive(recording: Recording, device: Device) -> str | None:
    """What is wrong with a recording whose motion persists without a drive of its axes; None if nothing is."""
    for name, (_, axes) in output_channels(recording, device).items():
        if any(f"{kind}_{axis}" in recording for axis in axes for kind in ("drive", "bias")):
            continue
        channel, tenth = recording[name], recording[name].size // 10
        rates = [np.pi * device.axis(axis).resonance / device.axis(axis).quality for axis in axes]
        if min(rates) * channel.size / channel.sample_rate < MIN_EXPECTED_DECAY:
            continue
        first, last = (_tone_amplitude(part) for part in (channel.read(0, tenth), channel.read(-tenth)))
        if last > MAX_STEADY_CHANGE * first > 0.0:
            return f"{name} moves steadily without {' and '.join(f'drive_{axis}' for axis in axes)}"
    return None


def _tone_amplitude(values: Array) -> float:
    """Amplitude of the strongest line of some samples, up to a constant; 0 if it has less than half of the power."""
    values = values[np.isfinite(values)]
    if values.size < 2:
        return 0.0
    power = np.abs(np.fft.rfft((values - values.mean()) * np.hanning(values.size))) ** 2
    peak = int(np.argmax(power))
    line = power[max(peak - LINE_WIDTH_BINS, 0) : peak + LINE_WIDTH_BINS + 1].sum()
    return float(np.sqrt(line)) if line > 0.5 * power.sum() else 0.0
