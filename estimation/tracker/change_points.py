"""Drives that switch within a block: they start, stop, or step in amplitude, frequency or phase.

Motion and drive are smooth between two switches only. A block that contains a switch uses the piece of its samples that
contains its middle. The reference phase gets a knot pair at the switch, and the state passes from one drive to the next
at that time (``state_space``).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from estimation.knot_smoother import find_jumps
from estimation.reference import PhaseReference
from estimation.tracker.demodulation import Projections, project_blocks, residual_variance
from scanner.arrays import Array, Index
from scanner.channel import Channel

SWITCH_VARIANCE_RATIO = 10.0
"""Residual variance of a block, over the median one, above which a switch is searched in it."""

MIN_SWITCH_VARIANCE_RATIO = 1e-6
"""Residual variance of a block relative to the power of the drive, above which a switch is searched in it. It applies
to drives without noise, whose median residual is rounding error."""

MAX_RESIDUAL_RATIO = 0.2
"""Largest ratio of the squared residuals with a switch to those without, at which the switch is accepted."""

EXTRAPOLATION_KNOTS = 4
"""Knots of the reference to which the line is fitted that continues it up to a switch."""

JUMP_WIDTH_S = 1e-9
"""Distance of the two knots of a phase jump [s]: below any sample interval, above the rounding of a time of 1e6 s."""


def find_switch_times(
    channel: Channel,
    reference: PhaseReference,
    starts: Index,
    length: int,
    fitted: Projections,
    orders: Index,
    square: bool,
) -> Array:
    """Times at which a drive switched, at most one a block, shape (switches,) [s].

    Searched in blocks whose residual variance is high, in those at which the reference jumps, and in those half a block
    earlier and later: of a switch between two blocks the reference alone is wrong in either, which noise hides. The
    drive of the preceding block and the drive of the next one are continued through the block; the switch is where the
    first followed by the second has the least squared residuals. It is accepted if these are below MAX_RESIDUAL_RATIO
    of those without a switch.

    Args:
        starts: first sample of every block, shape (blocks,). length: of a block [samples].
        fitted: projections of the drive in all blocks. orders: harmonics of the reference in the drive.
        square: whether the force is the square of the drive's voltage.
    """
    variance, found = residual_variance(fitted), []
    min_power = MIN_SWITCH_VARIANCE_RATIO * float(fitted.squares.max()) / length
    searched_blocks = variance > max(SWITCH_VARIANCE_RATIO * float(np.nanmedian(variance)), min_power)
    searched_blocks[_blocks_of_jumps(channel, reference, starts)] = True
    for k in np.flatnonzero(searched_blocks):
        if 0 < k < starts.size - 1:
            windows = [int(starts[k]) + shift for shift in (-length // 2, 0, length // 2)]
            searched = [_find_switch(channel, reference, first, length, orders, square, min_power) for first in windows]
            ratio, time = min(searched, key=lambda each: each[0])
            if ratio < MAX_RESIDUAL_RATIO:
                found.append((ratio, time))
    return _distinct_times(found, length / channel.sample_rate)


def _blocks_of_jumps(channel: Channel, reference: PhaseReference, starts: Index) -> Index:
    """Numbers of the blocks at which the phase of the reference jumps between two knots."""
    jumps, _ = find_jumps(reference.slow)
    sample = (reference.knots[jumps] - channel.start) * channel.sample_rate
    return np.unique(np.clip(np.searchsorted(starts, sample, side="right") - 1, 0, starts.size - 1))


def _distinct_times(found: Sequence[tuple[float, float]], width: float) -> Array:
    """Times of switches, increasing; of those within half a block, the one of the best fit.

    Args:
        found: ratio of the squared residuals and time of each. width: of a block [s].
    """
    times: list[float] = []
    for _, time in sorted(found):
        if all(abs(other - time) > 0.5 * width for other in times):
            times.append(time)
    return np.array(sorted(times))


def _find_switch(
    channel: Channel,
    reference: PhaseReference,
    first: int,
    length: int,
    orders: Index,
    square: bool,
    min_power: float,
) -> tuple[float, float]:
    """Squared residuals with a switch over those without, and its time [s]; (inf, nan) where there is no switch.

    Without a switch, the block has a drive of its own, or that of the block on one side.

    Args:
        first: first sample of the block; the others as for :func:`find_switch_times`.
        min_power: residual power below which a drive is exact.
    """
    if first < length or first + 2 * length > channel.size:
        return np.inf, np.nan
    low, high = (channel.start + sample / channel.sample_rate for sample in (first, first + length))
    sides = (first - length, _phase_before(reference, low)), (first + length, _phase_after(reference, high))
    before, after = (
        np.cumsum(_squared_residuals(channel, side or reference.phase, near, first, length, orders, square))
        for near, side in sides
    )
    own = float(_squared_residuals(channel, reference.phase, first, first, length, orders, square).sum())
    residuals = before + after[-1] - after
    at = int(residuals.argmin())
    without = min(own, float(before[-1]), float(after[-1]))
    if not (0 < at < length - 1 and without > min_power * length):
        return np.inf, np.nan
    return float(residuals[at]) / without, low + (at + 0.5) / channel.sample_rate


def _squared_residuals(
    channel: Channel,
    phase: Callable[[Array], Array],
    near: int,
    first: int,
    length: int,
    orders: Index,
    square: bool,
) -> Array:
    """Squared residuals of the block at sample ``first`` from the drive of the block at ``near``, shape (length,)."""

    def table(start: int) -> tuple[Array, Array]:
        values = np.nan_to_num(channel.read(start, start + length))
        angle = orders[:, None] * phase(channel.time(start, start + length))
        rows = np.concatenate([np.ones((1, length)), np.cos(angle), np.sin(angle)])
        return rows, values**2 if square else values

    rows, values = table(near)
    lines = np.linalg.lstsq(rows.T, values, rcond=None)[0]
    rows, values = table(first)
    return (values - lines @ rows) ** 2


def _phase_before(reference: PhaseReference, time: float) -> Callable[[Array], Array] | None:
    """Linear continuation of the reference before ``time``, from knots that end before it; None without a drive."""
    knots = np.flatnonzero(reference.knots < time - 0.5 * _knot_spacing(reference))
    return _extrapolate_phase(reference, knots[-EXTRAPOLATION_KNOTS:], time)


def _phase_after(reference: PhaseReference, time: float) -> Callable[[Array], Array] | None:
    """Linear continuation of the reference after ``time``, from knots that begin after it; None without a drive."""
    knots = np.flatnonzero(reference.knots > time + 0.5 * _knot_spacing(reference))
    return _extrapolate_phase(reference, knots[:EXTRAPOLATION_KNOTS], time)


def _extrapolate_phase(reference: PhaseReference, knots: Index, time: float) -> Callable[[Array], Array] | None:
    """Reference phase [rad] as a function of time [s], linear through those of the ``knots`` that are near ``time``."""
    near = knots[np.abs(reference.knots[knots] - time) < (EXTRAPOLATION_KNOTS + 1) * _knot_spacing(reference)]
    if near.size < 2:
        return None
    slope, value = np.polyfit(reference.knots[near] - time, reference.slow[near], 1)
    return lambda t: value + slope * (t - time) + 2 * np.pi * reference.frequency * t


def _knot_spacing(reference: PhaseReference) -> float:
    """Median time between two knots [s]."""
    return float(np.median(np.diff(reference.knots)))


def with_switches(reference: PhaseReference, times: Array) -> PhaseReference:
    """The reference with a bend or a jump at each of ``times``, shape (switches,) [s].

    Knots that average over a switch are removed. While there is no drive, the last one is continued: the motion decays
    near that frequency.
    """
    clean = np.abs(reference.knots[:, None] - times).min(axis=1) > 0.5 * _knot_spacing(reference)
    smooth = replace(reference, knots=reference.knots[clean], slow=reference.slow[clean])
    knots, slow = [smooth.knots], [smooth.slow]
    last: Callable[[Array], Array] | None = None
    for time in times:
        after = _phase_after(smooth, time)
        last = _phase_before(smooth, time) or last or after
        edges: Array = time + np.array([-0.5, 0.5]) * JUMP_WIDTH_S
        for edge, side in zip(edges, (last, after or last), strict=True):
            if side is not None:
                knots.append(np.array([edge]))
                slow.append(side(edge) - 2 * np.pi * reference.frequency * knots[-1])
    order = np.argsort(np.concatenate(knots), kind="stable")
    return replace(reference, knots=np.concatenate(knots)[order], slow=np.concatenate(slow)[order])


def block_pieces(starts: Index, length: int, rate: float, start: float, times: Array) -> Index:
    """First and stop sample, relative to the block's first, of the piece with the block's middle, shape (blocks, 2).

    Args:
        starts: first sample of every block, shape (blocks,). length: of a block [samples].
        rate, start: the channel's clock [Hz, s]. times: of the switches, shape (switches,) [s].
    """
    out = np.tile([0, length], (starts.size, 1))
    positions = (times - start) * rate
    for k, position in ((np.searchsorted(starts, p, side="right") - 1, p) for p in positions):
        if 0 <= k < starts.size and position < starts[k] + length:
            cut = int(np.ceil(position - starts[k]))
            out[k] = (max(out[k, 0], cut), out[k, 1]) if cut <= length // 2 else (out[k, 0], min(out[k, 1], cut))
    return out


def drive_shares(time: Array, switches: Array | None = None) -> Array:
    """Fraction of each step to the next block during which the block's drive acts, shape (blocks,).

    One half, or up to the switch.

    Args:
        time: of the blocks' middles, uniform, shape (blocks,) [s]. switches: shape (switches,) [s].
    """
    out = np.full(time.size, 0.5)
    if switches is None:
        return out
    position = (switches - time[0]) / (time[1] - time[0])
    inside = position[(position > 0.0) & (position < time.size - 1)]
    out[np.floor(inside).astype(np.int64)] = inside % 1.0
    return out


def project_cut_blocks(
    whole: Projections,
    channel: Channel,
    starts: Index,
    pieces: Index,
    lines: Index,
    omega: Array,
    squared: bool = False,
    may_clip: bool = True,
) -> Projections:
    """The projections, with the blocks that a switch cuts projected again from their piece; see ``project_blocks``."""
    length = int(pieces[:, 1].max())
    cut = np.flatnonzero(np.diff(pieces).ravel() < pieces[:, 1].max())
    by_block = ("sums", "squares", "counts", "clipped_counts", "rails", "table_w")
    out = replace(whole, **{name: getattr(whole, name).copy() for name in by_block})
    grams, geometry, count = [whole.grams], whole.geometry.copy(), len(whole.grams)
    for k in cut:
        block = project_block(channel, int(starts[k]), pieces[k], length, lines, omega[k], squared, may_clip)
        for name in by_block:
            getattr(out, name)[k] = getattr(block, name)[0]
        geometry[k] = count + block.geometry[0]
        grams.append(block.grams)
        count += len(block.grams)
    return replace(out, grams=np.concatenate(grams), geometry=geometry)


def project_block(
    channel: Channel,
    start: int,
    piece: Index,
    length: int,
    lines: Index,
    omega: Array,
    squared: bool = False,
    may_clip: bool = True,
) -> Projections:
    """Projection of one block, of which only ``piece`` (first, stop) is used; see ``project_blocks``."""
    values = channel.read(start, start + length)
    values[: piece[0]] = values[piece[1] :] = np.nan
    part = Channel(channel.name, channel.unit, channel.sample_rate, channel.start, values, 0, length)
    return project_blocks(part, np.zeros(1, np.int64), length, lines, omega[None], 0, squared, may_clip)
