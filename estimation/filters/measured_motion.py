"""From a measured angle to the motion of an axis: slow phase and amplitude, and the angle itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from estimation.filters.to_motion import BLOCK_CYCLES, Clock
from estimation.reference import PhaseReference
from estimation.signals import NOISE_SAMPLES, white_noise_sd
from scanner.angle_tracks import ChannelAngle
from scanner.arrays import Array, Complex
from scanner.channel import READ_CHUNK_SAMPLES, Channel
from scanner.errors import BadInput
from scanner.lock_in import block_phasors, phasor_noise, slow_clock_block
from scanner.motion import UNKNOWN_PHASE_SD_RAD, AxisMotion
from scanner.replaced_samples import with_samples

MIN_NOISE_SAMPLES_PER_PERIOD = 20.0
"""Samples per period from which the sixth differences of a signal show its noise: those of the motion itself are then
below 3e-5 of its amplitude."""

MIN_NOISE_EXCESS = 1.5
"""White noise in a position signal over ``noise_sd`` of its readout from which the measured noise is used, and a note
says so. Data sheets state noise to some ten percent."""

SPLINE_MARGIN_SAMPLES = 64
"""Samples beyond a part on either side that its spline includes. Their effect falls by a factor of 3.7 a sample, so
that the parts are those of one spline to the precision of the numbers."""

MIN_BLOCKS = 2
"""Blocks that a motion's slow clock has at least."""


def axis_motion_from_angle(
    angle: Channel,
    reference: PhaseReference,
    noise_sd: float | None,
    clock: Clock,
    held: Sequence[tuple[int, int]] = (),
) -> AxisMotion:
    """The motion of one axis from its measured angle.

    Args:
        angle: channel of the measured angle [rad].
        noise_sd: white noise of the sensor, per sample [rad], as stated; measured where None, and where an oversampled
            motion shows ``MIN_NOISE_EXCESS`` times as much.
        clock: of the angle in the result.
        held: ranges of samples that are missing or at which the sensor was stopped. The angle in the result is not
            known there (NaN). Phase and amplitude are interpolated through them, and the phase has the standard
            deviation of an unknown one.

    Raises:
        BadInput: the channel is shorter than two blocks, or is missing or was stopped in all but one.
    """
    rate = angle.sample_rate
    block = slow_clock_block(reference.frequency, rate, BLOCK_CYCLES, angle.size)
    stopped = np.zeros(angle.size, bool)
    for first, stop in held:
        stopped[first:stop] = True
    time, phasors = _phasors(angle, reference.frequency, block)
    if time.size < MIN_BLOCKS:
        raise BadInput(
            f"is too short to determine its phase: {2 * block} samples are needed",
            file=angle.file,
            channel=angle.name,
            hint="record for longer",
        )
    by_block = stopped[: time.size * block].reshape(-1, block)
    known = ~(by_block.all(axis=1) if reference.kind == "blocks" else by_block.any(axis=1))
    if known.sum() < MIN_BLOCKS:
        raise BadInput(
            "stands at one value, or lacks samples, in nearly all of the recording, as a sensor that was stopped",
            file=angle.file,
            channel=angle.name,
            hint="check the sensor and its cable, or cut the recording",
        )
    amplitude = np.interp(time, time[known], np.abs(phasors[known]))
    if reference.kind == "blocks":  # the part at a frequency that is no line says nothing of the range
        amplitude = np.full(time.size, 0.5 * float(np.ptp(angle.read()[~stopped])))
    is_noise_known = noise_sd is not None or rate >= MIN_NOISE_SAMPLES_PER_PERIOD * reference.frequency
    if noise_sd is None or rate >= MIN_NOISE_SAMPLES_PER_PERIOD * reference.frequency:
        measured = white_noise_sd(angle.read(0, NOISE_SAMPLES)[~stopped[:NOISE_SAMPLES]])
        if noise_sd is None or measured > MIN_NOISE_EXCESS * noise_sd:
            noise_sd = measured
    phase = np.interp(time, time[known], reference.relative_phase(time[known], phasors[known]))
    phase_sd = noise_sd / np.maximum(amplitude, 1e-300) * phasor_noise(rate, reference.frequency, block)
    phase_sd[by_block.mean(axis=1) >= 0.5] = UNKNOWN_PHASE_SD_RAD

    def oscillation(at: Array) -> Array:
        return np.asarray(np.interp(at, time, amplitude) * np.sin(reference.phase(at) + np.interp(at, time, phase)))

    return AxisMotion(
        time=time,
        phase=phase,
        amplitude=amplitude,
        frequency=reference.frequency_at(time) + np.gradient(phase, time) / (2 * np.pi),
        phase_sd=np.minimum(phase_sd, UNKNOWN_PHASE_SD_RAD),
        angle=_on_clock(angle, clock, held, np.zeros_like if reference.kind == "blocks" else oscillation),
        reference=reference.kind,
        reference_frequency=reference.frequency,
        sign=f"known: {angle.name}",
        angle_noise_sd=noise_sd if is_noise_known else 0.0,
    )


def _phasors(angle: Channel, frequency: float, block: int) -> tuple[Array, Complex]:
    """Amplitude and phase near ``frequency`` in consecutive blocks (:func:`block_phasors`), read in parts."""
    step = max(READ_CHUNK_SAMPLES // block, 1) * block
    parts = [
        block_phasors(
            angle.read(first, first + step), angle.sample_rate, angle.time(first, first + 1)[0], frequency, block
        )
        for first in range(0, angle.size, step)
    ]
    time, phasors = zip(*parts, strict=True)
    return np.concatenate(time), np.concatenate(phasors)


def _on_clock(
    angle: Channel, clock: Clock, unknown: Sequence[tuple[int, int]], oscillation: Callable[[Array], Array]
) -> ChannelAngle:
    """The samples of a channel on a clock, interpolated where that has other samples; NaN at unknown ones.

    Args:
        unknown: ranges of samples of the channel (first, stop).
        oscillation: as for :func:`_resampled`.
    """
    rate, start, n = clock
    first = (start - angle.start) * angle.sample_rate
    if rate == angle.sample_rate and abs(first - round(first)) < 1e-6 and 0 <= round(first) <= angle.size - n:
        begin = angle.first + round(first)
        resampled = replace(angle, start=start, first=begin, stop=begin + n)
    else:
        resampled = with_samples(replace(angle, sample_rate=rate, start=start), _resampled(angle, clock, oscillation))
    ranges = [[round((angle.start + at / angle.sample_rate - start) * rate) for at in each] for each in unknown]
    return ChannelAngle(resampled, [(max(low, 0), max(high, 0)) for low, high in ranges])


def _resampled(angle: Channel, clock: Clock, oscillation: Callable[[Array], Array]) -> Array:
    """Samples of a channel on another clock, part by part; NaN outside, shape (n,) [rad].

    A cubic spline interpolates what the oscillation leaves: one through a sine of 6 samples a period is off by 1 % of
    its amplitude, of 2.7 by 17 %. Less than a sample after the last one the rest is held.

    Args:
        oscillation: main part of the angle by time, shape (m,) -> (m,).
    """
    from scipy.interpolate import CubicSpline

    rate, start, n = clock
    values = np.empty(n)
    for first in range(0, n, READ_CHUNK_SAMPLES):
        time = start + np.arange(first, min(first + READ_CHUNK_SAMPLES, n)) / rate
        begin, end = (time[[0, -1]] - angle.start) * angle.sample_rate
        low = int(np.clip(begin - SPLINE_MARGIN_SAMPLES, 0, max(angle.size - 2 * SPLINE_MARGIN_SAMPLES, 0)))
        high = int(np.clip(end + SPLINE_MARGIN_SAMPLES, low + 2 * SPLINE_MARGIN_SAMPLES, None))
        at = angle.time(low, high)
        rest = CubicSpline(at, angle.read(low, high) - oscillation(at))
        part = rest(np.clip(time, at[0], at[-1])) + oscillation(time)
        part[(time < angle.start) | (time > angle.end)] = np.nan
        values[first : first + time.size] = part
    return values
