"""Recordings whose motion persists although the drive that keeps it up was not recorded: no model predicts them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import ceil

import numpy as np

from estimation.device_fit.data import Run, output_channels, prepare_run
from estimation.device_fit.model import Model
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

MIN_DRIVEN_SHARE = 0.01
"""Share of a channel, both as standard deviations, from which the motion that a drive causes counts. A driven axis
owes it most of its signal, and to the noise of a converter without a drive far less."""

NOISE_DIFFERENCE_ORDER, NOISE_DIFFERENCE_GAIN = 6, 924.0
"""Order of the differences that show noise between the samples of a drive, and their variance over that of white noise:
the sum of the squared binomial coefficients."""

MIN_NOISE_SHARE = 0.5
"""Standard deviation of white noise that these differences show, over that of the drive, from which it may be noise
alone. White noise has 1, and a tone of 10 samples a period 0.002."""


def steady_without_drive(recording: Recording, device: Device) -> str | None:
    """What is wrong with a recording whose motion persists without a drive of its axes; None if nothing is.

    A drive that was recorded and is constant keeps up no motion either, nor does noise alone that moves the device far
    less. Under it, the amplitude falls from the beginning to the end, and does not grow after a time in which a free
    motion of the device decays.

    Raises:
        BadInput: a drive of noise cannot be played through the device.
    """
    for name, (_, axes) in output_channels(recording, device).items():
        recorded = [f"{kind}_{axis}" for axis in axes for kind in ("drive", "bias") if f"{kind}_{axis}" in recording]
        varying = [values for drive in recorded if np.ptp(values := recording[drive].read()) != 0.0]
        if not all(map(_may_be_noise, varying)):
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
            if varying and _is_moved(recording, device, axes):
                continue
            drive = "noise alone in" if varying else "a constant"
            return f"{name} moves steadily or grows under {drive} {' and '.join(recorded)}"
        if steady:
            return f"{name} moves steadily without {' and '.join(f'drive_{axis}' for axis in axes)}"
    return None


def axes_without_drive(recording: Recording, device: Device) -> list[str]:
    """The axes of the measured channels of which neither drive nor bias was recorded."""
    measured = sorted({axis for _, axes in output_channels(recording, device).values() for axis in axes})
    return [axis for axis in measured if not {f"drive_{axis}", f"bias_{axis}"} & recording.channels.keys()]


def _may_be_noise(drive: Array) -> bool:
    """Whether the samples of a drive, shape (n,), are as irregular as white noise."""
    irregular = np.std(np.diff(drive, n=NOISE_DIFFERENCE_ORDER)) / np.sqrt(NOISE_DIFFERENCE_GAIN)
    return bool(irregular > MIN_NOISE_SHARE * np.std(drive))


def _is_moved(recording: Recording, device: Device, axes: Sequence[str]) -> bool:
    run = prepare_run(recording, device)
    return any(is_moved_by_drive(run, device, axis) for axis in axes)


def is_moved_by_drive(run: Run, device: Device, axis: str) -> bool:
    """Whether the variation of an axis's drive moves the nominal device visibly; its noise does not.

    The motions with the drive and with its mean begin at the amplitude of the recording: combs move no mirror at rest.
    """
    drive = run.inputs[axis]
    if np.ptp(drive.voltage) == 0.0:
        return False
    constant = replace(drive, voltage=np.full_like(drive.voltage, drive.voltage.mean()))
    driven, free = (
        Model([replace(run, inputs={**run.inputs, axis: inputs})], device, mains=()) for inputs in (drive, constant)
    )
    x = np.zeros(len(driven.parameters))
    x[[i for i, spec in enumerate(driven.parameters) if (spec.kind, spec.name) == ("start", "angle")]] = 1.0
    signals = zip(run.outputs, *(model.outputs(x)[0] for model in (driven, free)), strict=True)
    return any(
        np.std(with_drive - without) > MIN_DRIVEN_SHARE * np.std(output.data)
        for output, with_drive, without in signals
        if axis in output.axes
    )


def _tone_amplitude(values: Array) -> float:
    """Amplitude of the strongest line of some samples, up to a constant; 0 if it has less than half of the power."""
    values = values[np.isfinite(values)]
    if values.size < 2:
        return 0.0
    power = np.abs(np.fft.rfft((values - values.mean()) * np.hanning(values.size))) ** 2
    peak = int(np.argmax(power))
    line = power[max(peak - LINE_WIDTH_BINS, 0) : peak + LINE_WIDTH_BINS + 1].sum()
    return float(np.sqrt(line)) if line > 0.5 * power.sum() else 0.0
