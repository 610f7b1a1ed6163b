"""The phase that a motion's phase is told against: half the drive's, the drive's, or absolute."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanner.channel import Channel
from scanner.demodulate import block_length, block_phasors, unwrapped
from scanner.errors import BadInput

Array = NDArray[np.float64]

_CYCLES = 4  # of the drive, a block: a sweep of an eighth of the frequency each way is followed
_CHUNK = 1 << 19  # samples read at a time
_MOST = 1 << 18  # samples in which a line is looked for
_FEW_PERIODS = 3.0
_QUIET = 0.1  # of the largest amplitude: below it the drive counts as off and its phase goes on as it was


@dataclass(frozen=True)
class Reference:
    """Reference phase psi(t) of one axis: 2 pi f t plus a slow part given at knots.

    Attributes:
        kind: ``"half-drive"``, ``"drive"`` or ``"absolute"``.
        frequency: f, of the motion at the first knot [Hz].
        knots: times [s], shape (k,), at least 2. slow: psi - 2 pi f t at the knots [rad].
    """

    kind: str
    frequency: float
    knots: Array
    slow: Array

    def phase(self, time: Array) -> Array:
        """psi at ``time`` [s]: [rad]; beyond the knots it goes on at the end's frequency."""
        inside = np.interp(time, self.knots, self.slow)
        first, last = (
            np.diff(self.slow[:2]) / np.diff(self.knots[:2]),
            np.diff(self.slow[-2:]) / np.diff(self.knots[-2:]),
        )
        inside += np.minimum(time - self.knots[0], 0.0) * first + np.maximum(time - self.knots[-1], 0.0) * last
        return inside + 2 * np.pi * self.frequency * time

    def frequency_at(self, time: Array) -> Array:
        """psi' / 2 pi [Hz]: the motion's frequency but for the motion's own slow phase."""
        slope = np.gradient(self.slow, self.knots) / (2 * np.pi)
        return self.frequency + np.interp(time, self.knots, slope)


def absolute(frequency: float, start: float, end: float) -> Reference:
    """2 pi f t, where no drive was recorded."""
    return Reference("absolute", frequency, np.array([start, end]), np.zeros(2))


def drive_reference(drive: Channel, kind: str, low: float = 0.0) -> Reference:
    """The reference from a recorded drive voltage; through a gap (NaN) in it the phase runs straight.

    Args:
        drive: its channel.
        kind: ``"half-drive"`` for a parametric drive, ``"drive"`` for a linear one.
        low: the drive oscillates above this [Hz]; what is below comes from switching it on and off.

    Raises:
        BadInput: the drive holds no oscillation.
    """
    f = dominant_frequency(drive, low)
    block = block_length(f, drive.sample_rate, _CYCLES)
    if drive.size < 2 * block:
        raise BadInput(
            f"is {drive.size / drive.sample_rate:.3g} s long, less than {2 * _CYCLES} periods of its {f:.6g} Hz",
            file=drive.file,
            channel=drive.name,
            hint="record for longer",
        )
    looks: list[tuple[Array, Array, Array]] = []
    chunk = block * max(1, _CHUNK // block)
    for first in range(0, drive.size - block + 1, chunk):
        values = drive.stored(first, min(first + chunk, drive.size))
        start = drive.start + first / drive.sample_rate
        t, z = block_phasors(values, drive.sample_rate, start, f, block, drive.gain)
        looks.append((t, np.angle(z * np.exp(-2j * np.pi * f * t)), np.nan_to_num(np.abs(z))))
    time, phase, size = (np.concatenate(parts) for parts in zip(*looks, strict=True))
    on = size > _QUIET * size.max()
    time, phase = (time[on], phase[on]) if on.sum() >= 2 else (time, phase)
    slow = unwrapped(phase)
    share = 0.5 if kind == "half-drive" else 1.0
    return Reference(kind, share * f, time, share * slow)


def dominant_frequency(channel: Channel, low: float = 0.0, high: float = np.inf, window: float | None = None) -> float:
    """Frequency of the strongest line in (low, high) over the first ``window`` seconds (at most 2^18 samples) [Hz].

    A few periods of ``low`` are looked at first: they are enough where the line is there from the beginning.

    Raises:
        BadInput: no line stands out there.
    """
    most = min(channel.size, _MOST, round(window * channel.sample_rate) if window else _MOST)
    few = round(min(most, _FEW_PERIODS * channel.sample_rate / low)) if low > 0.0 else most
    few = 1 << (max(few, 1).bit_length() - 1)
    for n in (few, most):
        found = _strongest(channel.read(0, n), channel.sample_rate, low, high)
        if found is not None:
            return found
    raise BadInput("holds no oscillation", file=channel.file, channel=channel.name, hint="check that it was recorded")


def _strongest(values: Array, rate: float, low: float, high: float) -> float | None:
    """Frequency of the strongest line in (low, high) [Hz]; None where none stands out."""
    n = values.size
    values = np.nan_to_num(values - np.nanmean(values)) if np.isfinite(values).any() else np.zeros(n)
    padded = 1 << (2 * n - 1).bit_length()  # a power of two: a prime would take six times as long
    spectrum = np.abs(np.fft.rfft(values * np.hanning(n), padded))
    frequency = np.fft.rfftfreq(padded, 1.0 / rate)
    spectrum[(frequency <= max(low, 2.0 * rate / n)) | (frequency >= high)] = 0.0
    peak = int(spectrum[1:-1].argmax()) + 1
    rest = np.median(spectrum[spectrum > 0.0]) if (spectrum > 0.0).any() else 0.0
    if not spectrum[peak] > 10.0 * rest:
        return None
    around = np.log(np.maximum(spectrum[peak - 1 : peak + 2], 1e-300))
    shift = 0.5 * (around[0] - around[2]) / (around[0] - 2 * around[1] + around[2])
    return float(frequency[peak] + shift * frequency[1])
