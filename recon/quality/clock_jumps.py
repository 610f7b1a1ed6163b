"""Clock jumps: samples that were lost without a gap in the time base show as a jump of a line's phase.

The phase of a drive runs evenly, and the phase of a resonant mirror cannot jump, so a jump shows that the channel's
clock jumped. A phase gives the number of lost samples only up to whole periods, so nothing is repaired: a segment
between jumps is used.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from estimation.reference import dominant_frequency
from recon.imaging.gridding import accumulate_samples
from recon.imaging.picture import Grid
from recon.quality.defects import PHASE_JUMP, Defect
from scanner.arrays import Array
from scanner.channel import Channel
from scanner.device import AXES
from scanner.errors import BadInput
from scanner.lock_in import block_length, block_phasors
from scanner.motion import AxisMotion, Motion
from scanner.recording import Recording
from scanner.sample_ranges import merge_ranges, runs_of_true

CYCLES_PER_PHASE = 8.0
"""Cycles of a spectral line per phase sample: enough to average the noise, and at 10 kHz shorter than a millisecond."""

PHASE_SPACING_S = 2e-3
"""Time between phase samples. It bounds the cost; a mirror's phase changes little in this time."""

MAX_PHASES = 400
"""Phase samples of a channel. In a recording longer than 0.8 s they are further apart."""

NEIGHBOURS = 8
"""Steps of the phase on either side whose median is the expected step."""

MIN_JUMP_RAD = {"drive": 0.02, "sense": 0.3}
"""Smallest jump by kind of channel: the phase of a mirror drifts, that of a drive does not."""

DETECTION_SIGMA = 12.0
"""Smallest jump in standard deviations of the other steps. A channel has hundreds of steps, and a false jump discards
a part of the recording."""

ISOLATION_RATIO = 4.0
"""Smallest jump relative to the neighbouring steps. A transient changes those too, a jump does not."""

MIN_RELATIVE_AMPLITUDE = 0.3
"""Amplitude of the line relative to its median below which its phase is not used."""


def detect_clock_jumps(recording: Recording) -> list[Defect]:
    """Return the phase jumps of the drives, and of the sense signals at the lines of the drives.

    Returns:
        Defects of kind ``PHASE_JUMP``, channel by channel. A channel that does not oscillate has none.
    """
    lines: dict[str, float] = {}
    jumps: list[Defect] = []
    for name, channel in recording.channels.items():
        if name.startswith("drive_"):
            try:
                lines[name[-1]] = dominant_frequency(channel)
            except BadInput:  # it does not oscillate, so it has no phase
                continue
            jumps += _phase_jumps(channel, lines[name[-1]], MIN_JUMP_RAD["drive"])
    for name, channel in recording.channels.items():
        if name.startswith("sense"):
            for axis, frequency in lines.items():
                if name in ("sense", f"sense_{axis}"):
                    jumps += _phase_jumps(channel, frequency, MIN_JUMP_RAD["sense"])
    return jumps


def longest_segment(recording: Recording, jumps: Sequence[Defect]) -> tuple[float, float]:
    """Return begin and end [s] of the longest segment without a jump in which all channels have one clock."""
    intervals = jump_intervals(jumps)
    begins, ends = (
        [recording.start, *(stop for _, stop in intervals)],
        [*(start for start, _ in intervals), recording.end],
    )
    separate = separate_jump(jumps)
    last = recording.end if separate is None else separate.start
    segments = [(begin, end) for begin, end in zip(begins, ends, strict=True) if end <= last]
    return max(segments, key=lambda segment: segment[1] - segment[0])


def separate_jump(jumps: Sequence[Defect]) -> Defect | None:
    """Return the first jump of a sense signal at which no drive jumps; None if there is none.

    Samples that all channels lost shift the line of the drive in the drive too. Here the sense signal alone lost
    samples, so that from then on it is not on the clock of the other channels.
    """
    drives = [jump for jump in jumps if jump.channel.startswith("drive_")]
    separate = [
        jump
        for jump in jumps
        if jump.channel.startswith("sense")
        and not any(drive.start < jump.stop and jump.start < drive.stop for drive in drives)
    ]
    return min(separate, key=lambda jump: jump.start, default=None)


def jump_intervals(jumps: Sequence[Defect]) -> list[tuple[float, float]]:
    """Return the intervals of jumps [s], increasing. Drive and sense show the same jump: overlaps are merged."""
    return merge_ranges(sorted((jump.start, jump.stop) for jump in jumps), 0.0)


def mark_path_during_jumps(motion: Motion, jumps: Sequence[Defect], grid: Grid) -> NDArray[np.bool_]:
    """Mark the pixels that the beam would have crossed without the jumps next to the motion's begin and end.

    The motion is extrapolated as a sine into each jump. The samples there are not used, so these pixels may be missing
    from the picture.

    Returns:
        Shape (height, width).
    """
    counts = np.zeros((grid.height, grid.width), np.uint32)
    track = motion.axes["x"].angle
    begin, end = track.start, track.start + track.size / track.sample_rate
    for start, stop in jump_intervals(jumps):
        if min(abs(stop - begin), abs(start - end)) < 0.5 * (stop - start):
            time = np.arange(start, stop, 1 / track.sample_rate)
            x, y = (_extrapolated_angle(motion.axes[name], time) for name in AXES)
            accumulate_samples(x, y, np.zeros(time.size), grid, counts=counts)
    return counts > 0


def _extrapolated_angle(axis: AxisMotion, time: Array) -> Array:
    """Angles [rad] before the first or after the last sample of a motion, by a sine fitted to the nearest cycles.

    Samples of unknown angle are left out of the fit. The sine is NaN where all of them are unknown.
    """
    track, behind = axis.angle, time[0] > axis.angle.start
    omega = 2 * np.pi * axis.frequency[-1 if behind else 0]
    count = min(track.size, round(CYCLES_PER_PHASE * 2 * np.pi / omega * track.sample_rate))
    first = track.size - count if behind else 0

    def basis(at: Array) -> Array:
        return np.stack([np.ones_like(at), np.cos(omega * at), np.sin(omega * at)], -1)

    near = track.start + np.arange(first, first + count) / track.sample_rate
    angle = track.read(first, first + count)
    known = np.isfinite(angle)
    if not known.any():
        return np.full(time.size, np.nan)
    coefficients = np.linalg.lstsq(basis(near - near[0])[known], angle[known], rcond=None)[0]
    return np.asarray(basis(time - near[0]) @ coefficients, np.float64)


def _phase_jumps(channel: Channel, frequency: float, min_jump: float) -> Iterator[Defect]:
    """Jumps of a channel's phase at a line [Hz] by at least ``min_jump`` [rad]."""
    time, phase, amplitude = _sampled_phase(channel, frequency)
    if time.size < 2 * NEIGHBOURS:
        return
    step = _wrapped(np.diff(phase))
    step = _wrapped(step - np.angle(np.mean(np.exp(1j * step))))
    expected = np.array([np.median(step[max(0, i - NEIGHBOURS) : i + NEIGHBOURS + 1]) for i in range(step.size)])
    excess = step - expected
    pair = _wrapped(excess[:-1] + excess[1:])  # a jump within a phase sample is shared by the steps on both sides
    limit = max(min_jump, DETECTION_SIGMA * 1.48 * float(np.median(np.abs(pair))))
    beside = np.maximum(np.abs(excess[:-3]), np.abs(excess[3:]))
    strong = amplitude > MIN_RELATIVE_AMPLITUDE * np.median(amplitude)
    is_jump = (np.abs(pair[1:-1]) > np.maximum(limit, ISOLATION_RATIO * beside)) & strong[1:-3] & strong[3:-1]
    for low, high in runs_of_true(is_jump):
        yield Defect(channel.name, PHASE_JUMP, float(time[low + 1]), float(time[high + 2]))


def _sampled_phase(channel: Channel, frequency: float) -> tuple[Array, Array, Array]:
    """Times [s], phases against the line [rad] and amplitudes, each of shape (phase samples,)."""
    block = block_length(frequency, channel.sample_rate, CYCLES_PER_PHASE)
    stride = max(block, round(PHASE_SPACING_S * channel.sample_rate), channel.size // MAX_PHASES)
    stride = max(block, min(stride, channel.size // (4 * NEIGHBOURS)))
    firsts = np.arange(0, channel.size - block + 1, stride)
    blocks = np.concatenate([channel.read(first, first + block) for first in firsts.tolist()] or [np.empty(0)])
    _, phasors = block_phasors(blocks, channel.sample_rate, 0.0, frequency, block)  # phases at the blocks' centres
    time = channel.start + (firsts + 0.5 * (block - 1)) / channel.sample_rate
    finite = np.isfinite(phasors)  # blocks with a gap have no phase
    time = time[finite]
    phasors = phasors[finite] * np.exp(-2j * np.pi * frequency * time)
    return (
        np.asarray(time, np.float64),
        np.asarray(np.angle(phasors), np.float64),
        np.asarray(np.abs(phasors), np.float64),
    )


def _wrapped(angle: Array) -> Array:
    """Angles in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi
