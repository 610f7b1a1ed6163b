"""Drives that switch within a block: they start, stop, or jump in amplitude, frequency or phase.

Motion and drive are smooth only between two switches. A block keeps the piece of its samples that holds its middle,
the reference bends or jumps where the drive does, and the smoother passes from one drive to the next at that moment.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimation.reference import Reference
from estimation.tracker.blocks import Projections, project, residual_variance
from scanner.channel import Channel

Array = NDArray[np.float64]
Index = NDArray[np.int64]

ROUGH = 10.0  # times the usual variance about a block's fit: the drive may have switched in it
LEAST_ROUGH = 1e-6  # of the drive's power, the same
CLEARED = 0.2  # of what a block's own fit leaves, that a switch in it may leave
FITTED = 4  # knots of the reference that tell how it goes on behind them
EDGE = 1e-9  # s, between the two knots of a jump


def switch_times(
    channel: Channel, reference: Reference, starts: Index, length: int, fitted: Projections, orders: Index, square: bool
) -> Array:
    """When a drive switched, at most once a block, shape (switches,) [s].

    Looked for in blocks whose fit leaves more than others' do. The drive before, as the preceding block shows it, and
    the drive after are continued through the block; it switched where one with the other leaves the least squares. A
    block that this explains no better than its own fit has no switch.

    Args:
        starts: first sample of every block, shape (blocks,). length: of a block. fitted: the drive in all blocks.
        orders: harmonics of the reference in the drive.
        square: whether the drive's force follows its square.
    """
    rest, found = residual_variance(fitted), []
    usual = max(ROUGH * float(np.nanmedian(rest)), LEAST_ROUGH * float(fitted.squares.max()) / length)
    for k in np.flatnonzero(rest > usual):
        if not 0 < k < starts.size - 1:
            continue
        low, high = (channel.start + s / channel.sample_rate for s in (starts[k], starts[k] + length))
        sides = (starts[k - 1], _before(reference, low)), (starts[k + 1], _after(reference, high))
        before, after = (
            np.cumsum(_misfit(channel, side or reference.phase, int(near), int(starts[k]), length, orders, square))
            for near, side in sides
        )
        left = before + after[-1] - after
        at = int(left.argmin())
        if 0 < at < length - 1 and left[at] < CLEARED * rest[k] * fitted.counts[k]:
            found.append(low + (at + 0.5) / channel.sample_rate)
    return np.array(found)


def _misfit(
    channel: Channel,
    phase: Callable[[Array], Array],
    near: int,
    first: int,
    length: int,
    orders: Index,
    square: bool,
) -> Array:
    """Squared misfit of a block's samples from the drive that the block at ``near`` shows, shape (length,)."""

    def table(start: int) -> tuple[Array, Array]:
        values = np.nan_to_num(channel.read(start, start + length))
        turn = orders[:, None] * phase(channel.time(start, start + length))
        rows = np.concatenate([np.ones((1, length)), np.cos(turn), np.sin(turn)])
        return rows, values**2 if square else values

    rows, values = table(near)
    lines = np.linalg.lstsq(rows.T, values, rcond=None)[0]
    rows, values = table(first)
    return (values - lines @ rows) ** 2


def _before(reference: Reference, time: float) -> Callable[[Array], Array] | None:
    """How the reference went before ``time``, by the last knots that saw nothing after it; None for no drive."""
    return _straight(reference, np.flatnonzero(reference.knots < time - 0.5 * _spacing(reference))[-FITTED:], time)


def _after(reference: Reference, time: float) -> Callable[[Array], Array] | None:
    """How the reference went after ``time``, by the first knots that saw nothing before it; None for no drive."""
    return _straight(reference, np.flatnonzero(reference.knots > time + 0.5 * _spacing(reference))[:FITTED], time)


def _straight(reference: Reference, knots: Index, time: float) -> Callable[[Array], Array] | None:
    near = knots[np.abs(reference.knots[knots] - time) < (FITTED + 1) * _spacing(reference)]
    if near.size < 2:
        return None
    slope, value = np.polyfit(reference.knots[near] - time, reference.slow[near], 1)
    return lambda t: value + slope * (t - time) + 2 * np.pi * reference.frequency * t


def _spacing(reference: Reference) -> float:
    return float(np.median(np.diff(reference.knots)))


def with_switches(reference: Reference, times: Array) -> Reference:
    """The reference with a bend, or a jump, at each of ``times``: knots about it saw both drives and are left out.

    While there is no drive it goes on as the last one did: near that frequency the motion decays.
    """
    kept = np.abs(reference.knots[:, None] - times).min(axis=1) > 0.5 * _spacing(reference)
    own = replace(reference, knots=reference.knots[kept], slow=reference.slow[kept])
    knots, slow = [own.knots], [own.slow]
    last: Callable[[Array], Array] | None = None
    for time in times:
        after = _after(own, time)
        last = _before(own, time) or last or after
        edges: Array = time + np.array([-0.5, 0.5]) * EDGE
        for edge, side in zip(edges, (last, after or last), strict=True):
            if side is not None:
                knots.append(np.array([edge]))
                slow.append(side(edge) - 2 * np.pi * reference.frequency * knots[-1])
    order = np.argsort(np.concatenate(knots), kind="stable")
    return replace(reference, knots=np.concatenate(knots)[order], slow=np.concatenate(slow)[order])


def pieces(starts: Index, length: int, rate: float, start: float, times: Array) -> Index:
    """First and last but one sample, from a block's first, of the piece that holds the block's middle, (blocks, 2)."""
    out = np.tile([0, length], (starts.size, 1))
    at = (times - start) * rate
    for k, inside in ((np.searchsorted(starts, t, side="right") - 1, t) for t in at):
        if 0 <= k < starts.size and inside < starts[k] + length:
            cut = int(np.ceil(inside - starts[k]))
            out[k] = (max(out[k, 0], cut), out[k, 1]) if cut <= length // 2 else (out[k, 0], min(out[k, 1], cut))
    return out


def shares(time: Array, switches: Array | None = None) -> Array:
    """Part of each step to the next block over which a block's own drive lasts, shape (blocks,): half, or to a switch.

    Args:
        time: of the blocks' middles, uniform [s]. switches: [s].
    """
    out = np.full(time.size, 0.5)
    if switches is None:
        return out
    at = (switches - time[0]) / (time[1] - time[0])
    inside = at[(at > 0.0) & (at < time.size - 1)]
    out[np.floor(inside).astype(np.int64)] = inside % 1.0
    return out


def project_pieces(
    whole: Projections,
    channel: Channel,
    starts: Index,
    pieces: Index,
    lines: Index,
    omega: Array,
    squared: bool = False,
    may_clip: bool = True,
) -> Projections:
    """The projections with the blocks that a switch cuts made anew from their piece; see ``blocks.project``."""
    cut = np.flatnonzero(np.diff(pieces).ravel() < pieces[:, 1].max())
    by_block = ("sums", "squares", "counts", "beyond", "rails", "tuned")
    out = replace(whole, **{name: getattr(whole, name).copy() for name in by_block})
    grams, geometry, count = [whole.grams], whole.geometry.copy(), len(whole.grams)
    for k in cut:
        own = project_one(
            channel, int(starts[k]), pieces[k], int(pieces[:, 1].max()), lines, omega[k], squared, may_clip
        )
        for name in by_block:
            getattr(out, name)[k] = getattr(own, name)[0]
        geometry[k] = count + own.geometry[0]
        grams.append(own.grams)
        count += len(own.grams)
    return replace(out, grams=np.concatenate(grams), geometry=geometry)


def project_one(
    channel: Channel,
    start: int,
    piece: Index,
    length: int,
    lines: Index,
    omega: Array,
    squared: bool = False,
    may_clip: bool = True,
) -> Projections:
    """One block, of which a piece is used; see ``blocks.project``."""
    values = channel.read(start, start + length)
    values[: piece[0]] = values[piece[1] :] = np.nan
    part = Channel(channel.name, channel.unit, channel.sample_rate, channel.start, values, 0, length)
    return project(part, np.zeros(1, np.int64), length, lines, omega[None], 0, squared, may_clip)
