"""The reference against which the phase of a motion is stated: half the drive's phase, the drive's, or 2 pi f t."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimation.knot_smoother import smooth_knots
from estimation.short_tone import MIN_PERIODS, fit_short_tone
from scanner.arrays import Array, Complex
from scanner.channel import Channel
from scanner.errors import BadInput
from scanner.lock_in import block_phasors, slow_clock_block, unwrap_phase
from scanner.signal_check import hint_of_dead

MIN_RELATIVE_FREQUENCY = 0.2
"""Frequency of a motion over the resonance below which the mirror follows its drive slowly: the spring balances the
drive. The inertia, whose exchange of energy with the spring the tracker averages, then has 4 % of its force."""

BLOCK_CYCLES = 4
"""Cycles of the drive per block: the phase then advances by less than half a cycle a block for a chirp of up to an
eighth of the frequency each way, and can be unwrapped."""

CHUNK_SAMPLES = 1 << 19
"""Samples read at a time, which bounds the memory."""

MAX_SPECTRUM_SAMPLES = 1 << 18
"""Samples in whose spectrum a line is searched."""

MIN_SPECTRUM_SAMPLES = 8
"""Samples from which a spectrum can show a line over its median."""

SHORT_SPECTRUM_PERIODS = 3.0
"""Periods of the lowest frequency that are searched first: enough where the line is present from the beginning."""

MOTION_RATIO = 0.01
"""Amplitude over its largest from which a motion has begun: the noise of a sensor in a block is below a thousandth."""

DRIVE_ON_RATIO = 0.1
"""Amplitude relative to the largest below which the drive counts as off; its phase is then interpolated."""

LINE_RATIO = 10.0
"""Height of a line over the median of the spectrum from which it counts as an oscillation."""

MAX_SLOW_SEARCH_SAMPLES = 1 << 22
"""Samples in which a line far below the resonance is searched: 40 s at 100 kHz, and 32 MB of doubles."""

SLOW_SAMPLES_PER_CYCLE = 8
"""Means per cycle of the highest frequency of that search, which keep 97 % of its amplitude."""

SLOW_LINE_SHARE = 0.5
"""Share of a signal's variance from which one line is its main oscillation. The fundamental of a sawtooth has 0.61,
that of an Archimedean spiral 0.75; each line of a step above 2 / duration has less than 0.1."""

MIN_SAMPLES_PER_PERIOD = 2.5
"""Smallest number of samples of a channel per period of the resonance: 2 by the sampling theorem, and a quarter more
for the transition band of the decimation filter."""


@dataclass(frozen=True)
class PhaseReference:
    """Reference phase psi(t) of one axis: 2 pi f t plus a slow part given at knots.

    Attributes:
        kind: ``"half-drive"``, ``"drive"``, ``"absolute"`` or ``"blocks"``.
        frequency: f, of the motion at the first knot [Hz].
        knots: times [s], shape (k,), at least 2. slow: psi - 2 pi f t at the knots [rad].
    """

    kind: str
    frequency: float
    knots: Array
    slow: Array

    def phase(self, time: Array) -> Array:
        """psi at ``time`` [s]: [rad]; extrapolated beyond the knots at the frequency of the nearest end."""
        inside = np.interp(time, self.knots, self.slow)
        first, last = (
            np.diff(self.slow[:2]) / np.diff(self.knots[:2]),
            np.diff(self.slow[-2:]) / np.diff(self.knots[-2:]),
        )
        inside += np.minimum(time - self.knots[0], 0.0) * first + np.maximum(time - self.knots[-1], 0.0) * last
        return inside + 2 * np.pi * self.frequency * time

    def relative_phase(self, time: Array, phasors: Complex) -> Array:
        """Phase of ``phasors`` less psi at ``time`` [s]: [rad], without jumps, within half a turn at first.

        Before the first phasor of a motion the mirror is at rest, and the phases of the noise would give the unwrapped
        ones any slope. They are within half a turn of that phasor.
        """
        phase, size = np.angle(phasors * np.exp(-1j * self.phase(time))), np.nan_to_num(np.abs(phasors))
        if not size.size:
            return phase
        first = int(np.argmax(size >= MOTION_RATIO * size.max()))
        rest = phase[first] + np.angle(np.exp(1j * (phase[:first] - phase[first])))
        return np.concatenate([rest, unwrap_phase(phase[first:])])

    def frequency_at(self, time: Array) -> Array:
        """Frequency of the reference, psi' / 2 pi, at ``time`` [s]: shape (n,) [Hz]."""
        slope = np.gradient(self.slow, self.knots) / (2 * np.pi)
        return self.frequency + np.interp(time, self.knots, slope)


def block_reference(frequency: float, start: float, end: float) -> PhaseReference:
    """The reference 2 pi f t for a motion that repeats at no known frequency; f only determines the blocks of time."""
    return PhaseReference("blocks", frequency, np.array([start, end]), np.zeros(2))


def absolute_reference(frequency: float, start: float, end: float) -> PhaseReference:
    """The reference 2 pi f t from ``start`` to ``end`` [s], for a recording without a drive."""
    return PhaseReference("absolute", frequency, np.array([start, end]), np.zeros(2))


def drive_reference(
    drive: Channel,
    kind: str,
    low: float = 0.0,
    frequency: float | None = None,
    span: tuple[float, float] | None = None,
) -> PhaseReference:
    """The reference from a recorded drive voltage; the phase is interpolated linearly through gaps (NaN).

    Noise of the voltage, and edges between coarse samples, would move the reference from block to block, which no
    mirror follows: the phases of the blocks are smoothed as far as they have noise.

    Args:
        drive: its channel.
        kind: ``"half-drive"`` for a parametric drive, ``"drive"`` for a linear one.
        low: lower bound of the drive's frequency [Hz]; lines below come from switching it on and off.
        frequency: of the drive in an earlier segment [Hz], near which it is still; searched for where None.
        span: first and last time of the reference [s], by default those of the drive: see ``_with_steady_ends``.

    Raises:
        BadInput: the drive holds no oscillation.
    """
    f = frequency or tone_frequency(drive, low)
    time, phasors, block = drive_phasors(drive, f, BLOCK_CYCLES)
    if drive.size < 2 * block:
        raise BadInput(
            f"is {drive.size / drive.sample_rate:.3g} s long, less than {MIN_PERIODS:g} periods of its {f:.6g} Hz",
            file=drive.file,
            channel=drive.name,
            hint="record for longer",
        )
    phase, size = np.angle(phasors), np.nan_to_num(np.abs(phasors))
    on = size > DRIVE_ON_RATIO * size.max()
    time, phase = (time[on], phase[on]) if on.sum() >= 2 else (time, phase)
    slow = unwrap_phase(phase)
    slow = smooth_knots(time, slow) if np.isfinite(slow).all() else slow
    time, slow = _with_steady_ends(time, slow, *(span or (drive.start, drive.end)))
    ratio = 0.5 if kind == "half-drive" else 1.0
    return PhaseReference(kind, ratio * f, time, ratio * slow)


def _with_steady_ends(time: Array, slow: Array, start: float, end: float) -> tuple[Array, Array]:
    """Knots of a phase that continues to ``start`` and ``end`` [s] at the frequency of its part beside them.

    The frequency is that of a part as long as the extension, which bounds the error of the phase at its end to a few
    times that of single knots. Knots that reach the ends within their distance are returned as they are.

    Args:
        time, slow: of the knots, shape (n,) [s, rad].
    """
    if time.size < 2:
        return time, slow
    distance, ends = float(np.median(np.diff(time))), []
    for at, reach in ((start, time[0] - start), (end, end - time[-1])):
        if reach <= distance:
            continue
        near = np.abs(time - at) <= max(2.0 * reach, reach + distance)
        middle = float(time[near].mean())
        slope, level = np.polyfit(time[near] - middle, slow[near], 1) if near.sum() > 1 else (0.0, slow[near].mean())
        ends.append((at, level + slope * (at - middle)))
    times, phases = np.append(time, [each[0] for each in ends]), np.append(slow, [each[1] for each in ends])
    order = np.argsort(times)
    return times[order], phases[order]


def drive_phasors(drive: Channel, frequency: float, cycles: float) -> tuple[Array, Complex, int]:
    """Amplitude and phase of a channel against 2 pi f t, block by block.

    Args:
        frequency: f [Hz]. cycles: of a block, see ``slow_clock_block``.

    Returns:
        (centres of the blocks [s], phasors as of ``block_phasors``, both of shape (blocks,); samples of a block).
    """
    block = slow_clock_block(frequency, drive.sample_rate, cycles, drive.size)
    chunks: list[tuple[Array, Complex]] = [(np.empty(0), np.empty(0, np.complex128))]
    chunk = block * max(1, CHUNK_SAMPLES // block)
    for first in range(0, drive.size - block + 1, chunk):
        values = drive.stored(first, min(first + chunk, drive.size))
        start = drive.start + first / drive.sample_rate
        t, z = block_phasors(values, drive.sample_rate, start, frequency, block, drive.gain)
        chunks.append((t, z * np.exp(-2j * np.pi * frequency * t)))
    time, phasors = (np.concatenate(parts) for parts in zip(*chunks, strict=True))
    return time, phasors, block


def tone_frequency(channel: Channel, low: float = 0.0, high: float = np.inf, window: float | None = None) -> float:
    """Frequency of a tone in (low, high) [Hz], also of few periods.

    Args:
        window: duration from the start that is searched [s]; at most 2^18 samples, which is the default.

    Raises:
        BadInput: the channel holds no oscillation there.
    """
    duration, most = channel.size / channel.sample_rate, 2 * BLOCK_CYCLES
    found = _spectral_frequency(channel, low, high, window)
    if (found is None or found * duration < most) and low * duration < most:
        found = fit_short_tone(channel, low, min(most, high * duration)) or found
    if found is None:
        raise _no_oscillation(channel)
    return found


def dominant_frequency(channel: Channel, low: float = 0.0, high: float = np.inf) -> float:
    """Frequency of the strongest line in (low, high) over the first 2^18 samples at most [Hz].

    A few periods of ``low`` are searched first, which is fast, unless samples are missing there (NaN).

    Raises:
        BadInput: no line exceeds the noise there.
    """
    found = _spectral_frequency(channel, low, high, None)
    if found is None:
        raise _no_oscillation(channel)
    return found


def _spectral_frequency(channel: Channel, low: float, high: float, window: float | None) -> float | None:
    """As ``dominant_frequency``; None if no line exceeds the noise."""
    window_samples = round(window * channel.sample_rate) if window else MAX_SPECTRUM_SAMPLES
    most = min(channel.size, MAX_SPECTRUM_SAMPLES, window_samples)
    few = round(min(most, SHORT_SPECTRUM_PERIODS * channel.sample_rate / low)) if low > 0.0 else most
    few = 1 << (max(few, 1).bit_length() - 1)
    for n in (few, most):
        values = channel.read(0, n)
        found = _strongest(values, channel.sample_rate, low, high)
        if found is not None and (n == most or np.isfinite(values).all()):
            return found
    return None


def sampled_too_slowly(channel: Channel, what: str, frequency: float, order: int = 1, remedy: str = "") -> BadInput:
    """The error of a channel with fewer than ``MIN_SAMPLES_PER_PERIOD`` samples in a period of what it should show.

    Args:
        what: that moves at ``frequency`` [Hz].
        order: harmonic of it that the channel shows.
        remedy: what helps beside a higher rate.
    """
    rate = f"is sampled at {channel.sample_rate:.4g} Hz, too slowly for {what} at {frequency:.4g} Hz"
    hint = f"record at {2.0 * MIN_SAMPLES_PER_PERIOD * order * frequency:.4g} Hz or more{remedy}"
    return BadInput(rate, file=channel.file, channel=channel.name, hint=hint)


def not_covered(channel: Channel, what: str, start: float, end: float, remedy: str = "") -> BadInput:
    """The error of a channel that was not recorded during all of ``what``, from ``start`` to ``end`` [s].

    Args:
        remedy: what helps beside a longer record.
    """
    both = max(start, channel.start), min(end, channel.end)
    cut = f", or cut the recording in Python: Recording.open(file).slice({both[0]:.6g}, {both[1]:.6g}).write(cut)"
    return BadInput(
        f"covers {channel.start:.6g} to {channel.end:.6g} s, {what} {start:.6g} to {end:.6g} s",
        file=channel.file,
        channel=channel.name,
        hint="record both over the same time" + remedy + (cut if both[0] < both[1] else ""),
    )


def _no_oscillation(channel: Channel) -> BadInput:
    """The error for a channel without a line."""
    hint = hint_of_dead(channel.name, "recorded")
    return BadInput("holds no oscillation", file=channel.file, channel=channel.name, hint=hint)


def has_slow_oscillation(channel: Channel, high: float) -> bool:
    """Whether one line below ``high`` [Hz] has more than ``SLOW_LINE_SHARE`` of the variance of a signal."""
    values = channel.read(0, min(channel.size, MAX_SLOW_SEARCH_SAMPLES))
    length = max(1, int(channel.sample_rate / (SLOW_SAMPLES_PER_CYCLE * high)))
    values = np.where(np.isfinite(values), values, np.nan)
    if np.isnan(values).all():
        return False
    means = np.nan_to_num(values - np.nanmean(values))[: values.size // length * length].reshape(-1, length).mean(1)
    found = _strongest(means, channel.sample_rate / length, 0.0, high)
    if found is None:
        return False
    window = np.hanning(means.size)
    turn = 2 * np.pi * found * length / channel.sample_rate * np.arange(means.size)
    amplitude = 2.0 * abs(np.sum(window * means * np.exp(-1j * turn))) / window.sum()
    return bool(0.5 * amplitude**2 > SLOW_LINE_SHARE * np.nanvar(values))


def _strongest(values: Array, rate: float, low: float, high: float) -> float | None:
    """Frequency of the strongest line in (low, high) [Hz]; None if none exceeds the noise."""
    n = values.size
    if n < MIN_SPECTRUM_SAMPLES:
        return None
    values = np.where(np.isfinite(values), values, np.nan)
    values = np.nan_to_num(values - np.nanmean(values)) if np.isfinite(values).any() else np.zeros(n)
    padded = 1 << (2 * n - 1).bit_length()  # a power of two: a prime would take six times as long
    spectrum = np.abs(np.fft.rfft(values * np.hanning(n), padded))
    frequency = np.fft.rfftfreq(padded, 1.0 / rate)
    spectrum[(frequency <= max(low, 2.0 * rate / n)) | (frequency >= high)] = 0.0
    peak = int(spectrum[1:-1].argmax()) + 1
    rest = np.median(spectrum[spectrum > 0.0]) if (spectrum > 0.0).any() else 0.0
    if not spectrum[peak] > LINE_RATIO * rest:
        return None
    around = np.log(np.maximum(spectrum[peak - 1 : peak + 2], 1e-300))
    shift = 0.5 * (around[0] - around[2]) / (around[0] - 2 * around[1] + around[2])
    return float(frequency[peak] + shift * frequency[1])
