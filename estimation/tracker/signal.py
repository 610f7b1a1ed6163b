"""One sense channel made ready for the smoother: references, drives, readout and projections, block by block.

What drives the axes is told for all blocks at once (``laid_out``), the samples section by section (``prepare``): of
those a long recording has more than memory.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimation.reference import Reference
from estimation.signals import Sense, drive_voltage, is_capacitive
from estimation.tracker.blocks import Projections, project, residual_variance, solved
from estimation.tracker.orbit import COS, DRIVEN, POINTS, SENSED, SIN, AxisLaw, axis_law
from estimation.tracker.step import Signal
from estimation.tracker.switches import pieces, project_one, project_pieces, shares, switch_times, with_switches
from scanner.channel import Channel
from scanner.device import Amdm, Axis, Device
from scanner.errors import BadInput
from scanner.harmonics import readout_response
from scanner.laws import capacitance
from scanner.recording import Recording

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Index = NDArray[np.int64]

SLOWEST_CYCLES = 2.0  # of the slowest axis in a block, at the least
DECAY_SHARE = 0.15  # of the fastest decay time, where that is longer: with 0.2 what walks within a block shows at 40 dB
NYQUIST_SHARE = 0.45  # of the sampling rate: the highest harmonic that is used
SETTLING = 15.0  # time constants of the readout's sections; at the beginning nobody knows their state
SLOW = 1.0  # Hz, at which a readout's delay of slow changes is taken
RUNGS = 400  # of the ladder from line to amplitude
POSITION_LINES = 3
MODEL_SHARE = 3e-3  # of the signal's rms: what laws linearised over a block leave unexplained, however quiet the signal
DISTURBED = 1.5  # times the usual variance about a block's fit: the block holds something else


class Clipped(NamedTuple):
    """Blocks with samples beyond a rail.

    Attributes:
        block: which they are, shape (n,). start: the channel's sample that each begins with, shape (n,).
        pieces: first and last but one sample that each may use, shape (n, 2).
        rails: between which samples were measured, infinite for none, shape (n, 2) [V].
    """

    block: Index
    start: Index
    pieces: Index
    rails: Array


NEVER_CLIPPED = Clipped(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2), np.int64), np.zeros((0, 2)))


@dataclass(frozen=True)
class Prepared:
    """A sense channel, its axes' laws and its blocks.

    Attributes:
        sense, references: where it comes from.
        laws: of ``sense.axes``, in their order.
        time: of the blocks' middles, shape (blocks,) [s].
        signal: for the smoother.
        clean: fraction of the samples that were used.
        clipped: blocks in which the signal left its rails.
        noise_var: of a sample in most blocks, NaN where there is none [V^2].
    """

    sense: Sense
    references: Mapping[str, Reference]
    laws: tuple[AxisLaw, ...]
    time: Array
    signal: Signal
    clean: float
    clipped: Clipped
    noise_var: float

    @property
    def rows(self) -> Array:
        """The laws as numbers, one a row: what compiled code takes."""
        return np.array(self.laws, dtype=np.float64)


@dataclass(frozen=True)
class Layout:
    """Blocks of a sense channel in time, and what drives its axes there; nothing of its samples yet.

    Attributes:
        sense: the channel. axes: of the device that it listens to. laws: theirs.
        references: with bends and jumps where a drive switched. switches: when they did, shape (switches,) [s].
        starts: first sample of every block, shape (blocks,). length: of a block. time: of the middles, (blocks,) [s].
        lines: (axis, order) of each line that is listened to, shape (lines, 2).
        psi, w, force, share: as in ``step.Signal``, shape (blocks, axes, ...).
    """

    sense: Sense
    axes: tuple[Axis, ...]
    laws: tuple[AxisLaw, ...]
    references: Mapping[str, Reference]
    switches: Array
    starts: Index
    length: int
    time: Array
    lines: Index
    psi: Array
    w: Array
    force: Complex
    share: Array


def laid_out(recording: Recording, device: Device, sense: Sense, references: Mapping[str, Reference]) -> Layout:
    """Blocks for one sense channel, and the drives that belong to it demodulated in them.

    Raises:
        BadInput: the channel is too short, or a drive does not cover it.
        DeviceInvalid: the device lacks a value.
    """
    channel, axes = sense.channel, tuple(device.axis(name) for name in sense.axes)
    length = _block_length(axes, [references[name].frequency for name in sense.axes], channel.sample_rate)
    count = channel.size // length
    if count < 3:
        raise BadInput(
            f"is {channel.size} samples long; {3 * length} are needed to track a motion",
            file=channel.file,
            channel=channel.name,
            hint="record for longer",
        )
    starts = np.arange(count) * length
    time: Array = channel.start + (starts + 0.5 * (length - 1)) / np.float64(channel.sample_rate)
    laws = tuple(axis_law(axis, sense.readout) for axis in axes)
    width = length / channel.sample_rate
    driven = [
        driven_blocks(drive_voltage(recording, name, gaps_ok=True), references[name], time, width, law)
        for name, law in zip(sense.axes, laws, strict=True)
    ]
    psi, w, force, share = (
        np.ascontiguousarray(np.stack([getattr(own, name) for own in driven], axis=1))
        for name in ("psi", "w", "force", "share")
    )
    return Layout(
        sense=sense,
        axes=axes,
        laws=laws,
        references={name: own.reference for name, own in zip(sense.axes, driven, strict=True)},
        switches=np.concatenate([own.switches for own in driven]),
        starts=starts,
        length=length,
        time=time,
        lines=_lines(axes, sense, w, channel.sample_rate),
        psi=psi,
        w=w,
        force=force,
        share=share,
    )


def prepare(layout: Layout, first: int = 0, stop: int | None = None) -> Prepared:
    """Demodulate the blocks ``first`` up to ``stop`` of a sense channel."""
    sense, channel, lines, length = layout.sense, layout.sense.channel, layout.lines, layout.length
    own = slice(first, stop)
    starts, w = layout.starts[own], layout.w[own]
    settling = 0
    if isinstance(sense.readout, Amdm) and sense.readout.lpf_hz:
        settling = int(SETTLING / (2 * np.pi * min(sense.readout.lpf_hz)) * channel.sample_rate)
    projections = project(channel, starts, length, lines, w, settling)
    cut = pieces(starts, length, channel.sample_rate, channel.start, layout.switches)
    if layout.switches.size:
        projections = project_pieces(projections, channel, starts, cut, lines, w)
    passed, passed_by_w = _passed(sense, lines, w)
    white, roots, unroots = whitened(projections.sums, projections.grams, projections.geometry)
    noise, usual = _noise(projections, channel, starts, cut, lines, w, sense.readout.noise_sd)
    signal = Signal(
        psi=layout.psi[own],
        w=w,
        force=layout.force[own],
        share=layout.share[own],
        step=length / channel.sample_rate,
        lines=lines,
        passed=np.ascontiguousarray(passed),
        passed_by_w=np.ascontiguousarray(passed_by_w),
        mean_gain=float(readout_response(sense.readout, 0.0).real),
        mean_delay=float(readout_response(sense.readout, SLOW).imag / (2 * np.pi * SLOW)),
        tuned=np.ascontiguousarray(projections.tuned),
        whitened=white,
        roots=np.ascontiguousarray(roots),
        unroots=unroots,
        geometry=projections.geometry,
        noise_var=noise,
        known=np.zeros(w.shape),
        known_var=np.full(w.shape, np.inf),
        ladder=np.stack([_ladder(axis, sense) for axis in layout.axes]),
        main=2 if is_capacitive(sense.readout) else 1,
    )
    clean = float((projections.counts - projections.beyond).sum()) / (starts.size * length)
    clipped = _clipped(projections, starts, cut, settling)
    return Prepared(sense, layout.references, layout.laws, layout.time[own], signal, clean, clipped, usual)


def _clipped(projections: Projections, starts: Index, cut: Index, settling: int) -> Clipped:
    """The blocks with a rail."""
    block = np.flatnonzero(np.isfinite(projections.rails).any(axis=1))
    pieces = cut[block].copy()
    pieces[:, 0] = np.maximum(pieces[:, 0], settling - starts[block])
    return Clipped(block, starts[block], pieces, projections.rails[block])


def _block_length(axes: Sequence[Axis], frequencies: list[float], rate: float) -> int:
    width = SLOWEST_CYCLES / min(frequencies)
    decays = [axis.quality / (np.pi * axis.resonance) for axis in axes if axis.mechanics is not None]
    return max(64, round(max([width, DECAY_SHARE * min(decays)] if decays else [width]) * rate))


def _lines(axes: Sequence[Axis], sense: Sense, w: Array, rate: float) -> Index:
    found = []
    for i, axis in enumerate(axes):
        if is_capacitive(sense.readout):
            even = axis.require_capacitance().theta_th == 0.0
            orders = range(2 if even else 1, SENSED + 1, 2 if even else 1)
        else:
            orders = range(1, POSITION_LINES + 1)
        found += [(i, n) for n in orders if n * w[:, i].max() < 2 * np.pi * NYQUIST_SHARE * rate]
    return np.array(found, dtype=np.int64).reshape(-1, 2)


class Driven(NamedTuple):
    """One axis's drive, block by block.

    Attributes:
        reference: with bends and jumps where the drive switched. switches: when it did, shape (switches,) [s].
        psi, w, force, share: as in ``step.Signal``, shape (blocks, ...).
    """

    reference: Reference
    switches: Array
    psi: Array
    w: Array
    force: Complex
    share: Array


def driven_blocks(channel: Channel | None, reference: Reference, time: Array, width: float, law: AxisLaw) -> Driven:
    """Reference and force about each block of ``width`` [s]; no force where none was recorded.

    Raises:
        BadInput: the drive does not cover the blocks.
    """
    psi, w = _course(reference, time, time - 0.5 * width, time + 0.5 * width)
    if channel is None:
        return Driven(reference, np.empty(0), psi, w, np.zeros((time.size, DRIVEN), np.complex128), shares(time))
    rate = channel.sample_rate
    length = round(width * rate)
    wanted = np.round((time - channel.start) * rate - 0.5 * (length - 1)).astype(np.int64)
    starts = np.clip(wanted, 0, channel.size - length)
    if channel.size < length or np.abs(starts - wanted).max() > length:
        raise BadInput(
            f"covers {channel.start:.6g} to {channel.end:.6g} s, the blocks {time[0]:.6g} to {time[-1]:.6g} s",
            file=channel.file,
            channel=channel.name,
            hint="record both over the same time",
        )
    orders = np.arange(1, DRIVEN + 2)  # one or two more than are used, so that they do not pass for these
    orders = law.turn * orders[orders * law.turn * w.max() < 2 * np.pi * NYQUIST_SHARE * rate]
    lines = np.stack([np.zeros_like(orders), orders], axis=1)
    squared = law.pull > 0.0
    told = project(channel, starts, length, lines, w[:, None], squared=squared, may_clip=False)
    switches = switch_times(channel, reference, starts, length, told, orders, squared)
    if switches.size:
        reference = with_switches(reference, switches)
        cut = pieces(starts, length, rate, channel.start, switches)
        low, high = channel.start + (starts + cut[:, 0]) / rate, channel.start + (starts + cut[:, 1] - 1) / rate
        psi, w = _course(reference, time, low, high)
        told = project_pieces(told, channel, starts, cut, lines, w[:, None], squared, may_clip=False)
    late = channel.start + (starts + 0.5 * (length - 1)) / rate - time
    fitted = solved(told)
    force = np.zeros((time.size, DRIVEN), np.complex128)
    force[:, 0] = fitted[:, 0]
    for m in range(1, min(DRIVEN, orders.size + 1)):
        turned = np.exp(-1j * m * law.turn * (psi + w * late))
        force[:, m] = (fitted[:, 2 * m - 1] - 1j * fitted[:, 2 * m]) * turned
    return Driven(reference, switches, psi, w, force, shares(time, switches))


def _course(reference: Reference, time: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """(phase at ``time`` [rad], rate [rad/s]) of the straight line that stands for the reference from low to high [s].

    Its mean is the reference's (Simpson): what a demodulation with a straight line sees of a sweep.
    """
    before, middle, after = reference.phase(low), reference.phase(0.5 * (low + high)), reference.phase(high)
    w = (after - before) / (high - low)
    return (before + 4.0 * middle + after) / 6.0 + w * (time - 0.5 * (low + high)), w


def _passed(sense: Sense, lines: Index, w: Array) -> tuple[Complex, Complex]:
    """Readout's response at each line of each block, and its derivative by the motion's angular frequency."""
    f = w[:, lines[:, 0]] * lines[:, 1] / (2 * np.pi)
    step = 1e-4
    high, low = (readout_response(sense.readout, f * (1.0 + s)) for s in (step, -step))
    return readout_response(sense.readout, f), (high - low) / (2.0 * step * w[:, lines[:, 0]])


def _noise(
    projections: Projections, channel: Channel, starts: Index, cut: Index, lines: Index, w: Array, noise_sd: float
) -> tuple[Array, float]:
    """Variance of each block's samples, shape (blocks,), and of most blocks': more where one holds a disturbance.

    Lines that slip or decay within a block leave much of themselves about a steady fit, and are no disturbance: blocks
    that seem to hold one are fitted with lines beside each line as well, which make it free to change.
    """
    if not projections.counts.any():  # a gap as long as all of it
        return np.ones(starts.size), np.nan
    own = residual_variance(projections)
    own[projections.rails[:, 0] == projections.rails[:, 1]] = noise_sd**2  # a comparator tells no volts
    samples = np.maximum(projections.counts, 1)
    swing = float(np.median(projections.squares / samples - (projections.sums[:, 0] / samples) ** 2))
    usual = max(float(np.nanmedian(own)), MODEL_SHARE**2 * swing)
    length = int(cut[:, 1].max())
    beside = channel.sample_rate / length  # [rad/s]: a turn of 1 rad over the block
    axes = w.shape[1]
    free = np.concatenate([*(lines + np.array([i * axes, 0]) for i in range(3)), [[3 * axes, 1]]])
    for k in np.flatnonzero(own > DISTURBED * usual):
        omega = np.concatenate([w[k], w[k] - beside, w[k] + beside, [np.pi * beside]])
        own[k] = residual_variance(project_one(channel, int(starts[k]), cut[k], length, free, omega))[0]
    return np.where(own > DISTURBED * usual, own, usual), usual


def whitened(sums: Array, grams: Array, geometry: Index) -> tuple[Array, Array, Array]:
    """(R's, R'G of all three moments, R), R'GR = 1, by eigenvectors; directions with no samples stay zero.

    Args:
        sums, grams, geometry: as in ``blocks.Projections``.
    """
    values, vectors = np.linalg.eigh(grams[:, 0])
    held = values > 1e-9 * np.maximum(values[:, -1:], 1.0)
    unroots = vectors * np.where(held, 1.0 / np.sqrt(np.where(held, values, 1.0)), 0.0)[:, None, :]
    out = np.empty_like(sums)
    for g, unroot in enumerate(unroots):
        mine = geometry == g
        out[mine] = sums[mine] @ unroot
    return out, np.swapaxes(unroots, 1, 2)[:, None] @ grams, np.ascontiguousarray(unroots)


def _ladder(axis: Axis, sense: Sense) -> Array:
    """Amplitudes and the size of their main line, up to the largest line there is, shape (2, RUNGS)."""
    if not is_capacitive(sense.readout):
        amplitudes = np.linspace(0.0, 2.0, RUNGS)
        return np.stack([amplitudes, amplitudes])
    comb = axis.require_capacitance()
    amplitudes = np.linspace(1e-4, 1.6, RUNGS) * comb.theta0
    seen = capacitance(amplitudes[:, None] * SIN[1], comb.C0, comb.Cb, comb.theta0, comb.theta_th)
    sizes = np.abs(seen @ COS[2]) * (2.0 / POINTS)
    top = int(sizes.argmax())  # beyond it a larger swing gives no larger line
    return np.stack([np.minimum(amplitudes, amplitudes[top]), np.maximum.accumulate(sizes)])
