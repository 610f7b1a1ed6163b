"""Block observations of one sense channel: references, drives, readout and whitened projections.

``lay_out_blocks`` places the blocks of the whole recording and demodulates the drives; ``demodulate_blocks`` projects
the samples of some of the blocks, because the samples of a long recording do not fit in memory.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import ceil
from typing import NamedTuple

import numpy as np

from estimation.reference import PhaseReference
from estimation.signals import SenseChannel, drive_channel, is_capacitive
from estimation.tracker.amplitude_table import amplitude_table
from estimation.tracker.averaged_dynamics import MAX_READOUT_HARMONIC, AxisParameters, axis_parameters
from estimation.tracker.block_signal import BlockSignal
from estimation.tracker.change_points import block_pieces, project_cut_blocks
from estimation.tracker.demodulation import (
    NoiseSpectrum,
    Projections,
    project_blocks,
    whiten_projections,
)
from estimation.tracker.drive_blocks import MAX_LINE_RATE_RATIO, demodulate_drive
from estimation.tracker.line_noise import (
    initial_offset_density,
    line_noise_variance,
    model_error_variance,
    noise_spectrum,
    sample_noise_variance,
)
from scanner.arrays import Array, Complex, Index
from scanner.channel import Channel
from scanner.device import Axis, Device
from scanner.errors import BadInput
from scanner.harmonics import readout_response
from scanner.recording import Recording
from scanner.stages import Amdm

MIN_BLOCKS = 3
"""Least number of blocks: a smoother needs a block between a first and a last one."""

MIN_BLOCK_CYCLES = 2.0
"""Least length of a block in cycles of the slowest axis: its harmonics are then separable from the other axis's."""

MIN_CYCLES_OF_RECORDING = 1.5
"""Least length of a recording in cycles of the slowest axis. Blocks of a recording that is shorter than ``MIN_BLOCKS``
usual ones are shorter too. A capacitance then repeats at least once in each, so that a block determines its mean."""

MAX_BLOCK_S = 1e-3
"""Largest length of a block with more than MIN_BLOCK_CYCLES [s]. Drift, and the change of the phase while the
amplitude passes near zero, take some milliseconds even if the decay is long; with blocks of 10 ms (Q 400 at 2 kHz) the
phase error was 6°."""

MIN_BLOCK_SAMPLES = 64
"""Least length of a block: enough for all lines of two axes."""

BLOCK_DECAY_TIMES = 0.15
"""Length of a block in units of the fastest decay time 1 / (pi f / Q), between MIN_BLOCK_CYCLES and MAX_BLOCK_S.

Longer blocks save time. With 0.2, the drift within a block adds to the phase error at 40 dB
(docs/explanation/tracker.md).
"""

SETTLING_TIME_CONSTANTS = 15.0
"""Time constants of the readout's slowest filter that are skipped at the beginning, where its state is unknown."""

DELAY_FREQUENCY_HZ = 1.0
"""Frequency at which the readout's delay of slow changes is evaluated [Hz]; far below every scan frequency."""

MOTION_SENSOR_HARMONICS = 3
"""Harmonics used of a sensor of the motion: the fundamental, and the next two, which a nonlinear suspension adds."""


class ClippedBlocks(NamedTuple):
    """Blocks with clipped samples.

    Attributes:
        block: their indices, shape (n,). start: the channel's first sample of each, shape (n,).
        pieces: first and stop sample that each uses, relative to start, shape (n, 2).
        rails: limits of the measured range, infinite for none, shape (n, 2) [V].
    """

    block: Index
    start: Index
    pieces: Index
    rails: Array


NO_CLIPPED_BLOCKS = ClippedBlocks(
    np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2), np.int64), np.zeros((0, 2))
)


@dataclass(frozen=True)
class BlockObservations:
    """Blocks of a sense channel, ready for the filter.

    Attributes:
        sense, references: channel and reference phases that they come from.
        parameters: of the axes ``sense.axes``, in their order.
        time: middles of the blocks, shape (blocks,) [s].
        signal: their measurements.
        used_fraction: of the samples.
        clipped: blocks with clipped samples.
        noise_var: variance of a sample in undisturbed blocks, NaN without samples [V^2].
    """

    sense: SenseChannel
    references: Mapping[str, PhaseReference]
    parameters: tuple[AxisParameters, ...]
    time: Array
    signal: BlockSignal
    used_fraction: float
    clipped: ClippedBlocks
    noise_var: float

    @property
    def parameter_rows(self) -> Array:
        """The parameters as numbers, one axis a row, for compiled code, shape (axes, 11)."""
        return np.array(self.parameters, dtype=np.float64)

    def with_offset_density(self, density: float) -> BlockObservations:
        """The observations with another spectral density of the readout's offset [V^2/s]."""
        return replace(self, signal=self.signal._replace(offset_density=density))


@dataclass(frozen=True)
class BlockLayout:
    """Times of all blocks of a sense channel, and the drives of its axes in them.

    Attributes:
        sense: the channel. axes: whose motion it measures. parameters: of these.
        references: with knots at the switches of the drives. switches: their times, shape (switches,) [s].
        starts: first sample of every block, shape (blocks,). length: of a block [samples].
        time: middles of the blocks, shape (blocks,) [s].
        lines: (axis, order) of each line that is used, shape (lines, 2).
        psi, w, force, drive_share: as in ``BlockSignal``, shape (blocks, axes, ...).
    """

    sense: SenseChannel
    axes: tuple[Axis, ...]
    parameters: tuple[AxisParameters, ...]
    references: Mapping[str, PhaseReference]
    switches: Array
    starts: Index
    length: int
    time: Array
    lines: Index
    psi: Array
    w: Array
    force: Complex
    drive_share: Array

    def with_channel(self, channel: Channel) -> BlockLayout:
        """The layout with other samples of its channel."""
        return replace(self, sense=replace(self.sense, channel=channel))


def lay_out_blocks(
    recording: Recording,
    device: Device,
    sense: SenseChannel,
    references: Mapping[str, PhaseReference],
    first: tuple[float, int] | None = None,
) -> BlockLayout:
    """Place the blocks of one sense channel and demodulate the drives of its axes in them.

    Args:
        first: time of the first sample [s] and length [samples] of the first block; by default the channel's start.

    Raises:
        BadInput: the channel is too short or sampled too slowly, or a drive does not cover it.
        DeviceInvalid: the device lacks a value.
    """
    channel, axes = sense.channel, tuple(device.axis(name) for name in sense.axes)
    slowest = min(references[name].frequency for name in sense.axes)
    length = _block_length(axes, slowest, channel.sample_rate)
    least = max(MIN_BLOCKS * MIN_BLOCK_SAMPLES, ceil(MIN_CYCLES_OF_RECORDING / slowest * channel.sample_rate))
    skipped = 0
    if first is not None:
        skipped, length = round((first[0] - channel.start) * channel.sample_rate), first[1]
    length = min(length, channel.size // MIN_BLOCKS)
    count = (channel.size - skipped) // max(length, 1)
    if channel.size < least or count < 1:
        raise BadInput(
            f"is {channel.size} samples long, {slowest * channel.size / channel.sample_rate:.2g} periods of a motion "
            f"at {slowest:.6g} Hz; {least} samples are needed to track it",
            file=channel.file,
            channel=channel.name,
            hint="record for longer",
        )
    starts = skipped + np.arange(count) * length
    time: Array = channel.start + (starts + 0.5 * (length - 1)) / np.float64(channel.sample_rate)
    parameters = tuple(axis_parameters(axis, sense.readout) for axis in axes)
    width = length / channel.sample_rate
    drives = [
        demodulate_drive(drive_channel(recording, name, gaps_ok=True), references[name], time, width, law)
        for name, law in zip(sense.axes, parameters, strict=True)
    ]
    psi, w, force, drive_share = (
        np.ascontiguousarray(np.stack([getattr(drive, name) for drive in drives], axis=1))
        for name in ("psi", "w", "force", "drive_share")
    )
    return BlockLayout(
        sense=sense,
        axes=axes,
        parameters=parameters,
        references={name: drive.reference for name, drive in zip(sense.axes, drives, strict=True)},
        switches=np.concatenate([drive.switches for drive in drives]),
        starts=starts,
        length=length,
        time=time,
        lines=_usable_lines(axes, sense, w),
        psi=psi,
        w=w,
        force=force,
        drive_share=drive_share,
    )


def demodulate_blocks(
    layout: BlockLayout, first: int = 0, stop: int | None = None, spectrum: NoiseSpectrum | None = None
) -> BlockObservations:
    """Demodulate the blocks ``first`` up to ``stop`` of a sense channel.

    Args:
        spectrum: of the noise of their projections; measured in these blocks by default.
    """
    sense, channel, lines, length = layout.sense, layout.sense.channel, layout.lines, layout.length
    part = slice(first, stop)
    starts, w = layout.starts[part], layout.w[part]
    settling = 0
    if isinstance(sense.readout, Amdm) and sense.readout.lpf_hz:
        settling = int(SETTLING_TIME_CONSTANTS / (2 * np.pi * min(sense.readout.lpf_hz)) * channel.sample_rate)
    projections = project_blocks(channel, starts, length, lines, w, settling)
    pieces = block_pieces(starts, length, channel.sample_rate, channel.start, layout.switches)
    if layout.switches.size:
        projections = project_cut_blocks(projections, channel, starts, pieces, lines, w)
    response, response_slope = _line_response(sense, lines, w)
    model_error = model_error_variance(projections)
    noise, median_noise = sample_noise_variance(
        projections, channel, starts, pieces, lines, w, sense.readout.noise_sd, model_error
    )
    if spectrum is None:
        line_noise = line_noise_variance(projections, channel, starts, length, lines, median_noise)
        spectrum = noise_spectrum(np.fmax(line_noise, model_error), median_noise, length)
    slow_noise = median_noise * (spectrum.white + length * float(spectrum.excess[0]))
    whitened, moments, _, solvers = whiten_projections(
        projections.sums, projections.grams, projections.geometry, spectrum
    )
    enough = projections.counts > projections.sums.shape[1]
    means = np.einsum("kj,kj->k", solvers[projections.geometry[enough], 0], whitened[enough])
    samples = float(np.median(projections.counts[enough])) if enough.any() else 0.0
    signal = BlockSignal(
        psi=layout.psi[part],
        w=w,
        force=layout.force[part],
        drive_share=layout.drive_share[part],
        step=length / channel.sample_rate,
        lines=lines,
        response=np.ascontiguousarray(response),
        response_slope=np.ascontiguousarray(response_slope),
        mean_gain=float(readout_response(sense.readout, 0.0).real),
        mean_delay=float(readout_response(sense.readout, DELAY_FREQUENCY_HZ).imag / (2 * np.pi * DELAY_FREQUENCY_HZ)),
        table_w=np.ascontiguousarray(projections.table_w),
        spectrum=spectrum,
        whitened=whitened,
        whitened_moments=np.ascontiguousarray(moments),
        solvers=solvers,
        geometry=projections.geometry,
        noise_var=noise,
        offset_density=initial_offset_density(means, samples, slow_noise, length / channel.sample_rate),
        external_phase=np.zeros(w.shape),
        external_var=np.full(w.shape, np.inf),
        amplitude_table=np.stack([amplitude_table(axis, sense.readout) for axis in layout.axes]),
        main_order=_main_order(sense),
    )
    used = float((projections.counts - projections.clipped_counts).sum()) / (starts.size * length)
    clipped = _clipped_blocks(projections, starts, pieces, settling)
    time = layout.time[part]
    return BlockObservations(sense, layout.references, layout.parameters, time, signal, used, clipped, median_noise)


def _clipped_blocks(projections: Projections, starts: Index, pieces: Index, settling: int) -> ClippedBlocks:
    """The blocks with a finite rail."""
    block = np.flatnonzero(np.isfinite(projections.rails).any(axis=1))
    used = pieces[block].copy()
    used[:, 0] = np.maximum(used[:, 0], settling - starts[block])
    return ClippedBlocks(block, starts[block], used, projections.rails[block])


def _block_length(axes: Sequence[Axis], slowest: float, rate: float) -> int:
    """Samples of a block of a long recording, from MIN_BLOCK_CYCLES, BLOCK_DECAY_TIMES and MAX_BLOCK_S.

    Args:
        slowest: frequency of the slowest axis [Hz]. rate: of the samples [Hz].
    """
    decays = [axis.quality / (np.pi * axis.resonance) for axis in axes if axis.mechanics is not None]
    width = min(BLOCK_DECAY_TIMES * min(decays), MAX_BLOCK_S) if decays else 0.0
    return max(MIN_BLOCK_SAMPLES, round(max(MIN_BLOCK_CYCLES / slowest, width) * rate))


def _main_order(sense: SenseChannel) -> int:
    """Order of the line that determines phase and amplitude: a capacitance has twice the motion's frequency."""
    return 2 if is_capacitive(sense.readout) else 1


def _usable_lines(axes: Sequence[Axis], sense: SenseChannel, w: Array) -> Index:
    """(axis, order) of the lines below MAX_LINE_RATE_RATIO; a comb that is symmetric has even orders only.

    Raises:
        BadInput: the main line of an axis is above it.
    """
    found, channel, main = [], sense.channel, _main_order(sense)
    for i, axis in enumerate(axes):
        if is_capacitive(sense.readout):
            even = axis.require_capacitance().theta_th == 0.0
            orders = range(2 if even else 1, MAX_READOUT_HARMONIC + 1, 2 if even else 1)
        else:
            orders = range(1, MOTION_SENSOR_HARMONICS + 1)
        least_rates = {n: n * w[:, i].max() / (2 * np.pi * MAX_LINE_RATE_RATIO) for n in orders}
        if least_rates[main] >= channel.sample_rate:
            raise BadInput(
                f"is sampled at {channel.sample_rate:g} Hz, too slowly for the line at "
                f"{least_rates[main] * MAX_LINE_RATE_RATIO:.6g} Hz by which axis {sense.axes[i]} is tracked",
                file=channel.file,
                channel=channel.name,
                hint=f"record at {ceil(least_rates[main])} Hz or more",
            )
        found += [(i, n) for n, least_rate in least_rates.items() if least_rate < channel.sample_rate]
    return np.array(found, dtype=np.int64).reshape(-1, 2)


def _line_response(sense: SenseChannel, lines: Index, w: Array) -> tuple[Complex, Complex]:
    """Readout's response at each line of each block, and its derivative by the motion's angular frequency."""
    f = w[:, lines[:, 0]] * lines[:, 1] / (2 * np.pi)
    step = 1e-4
    high, low = (readout_response(sense.readout, f * (1.0 + s)) for s in (step, -step))
    return readout_response(sense.readout, f), (high - low) / (2.0 * step * w[:, lines[:, 0]])
