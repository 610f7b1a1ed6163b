"""Drive of one axis, block by block: reference phase, harmonics of the force, and switches."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimation.reference import PhaseReference, not_covered
from estimation.tracker.averaged_dynamics import FORCE_HARMONICS, AxisParameters
from estimation.tracker.change_points import (
    block_pieces,
    drive_shares,
    find_switch_times,
    project_cut_blocks,
    with_switches,
)
from estimation.tracker.demodulation import least_squares_coefficients, project_blocks
from scanner.arrays import Array, Complex
from scanner.channel import Channel

MAX_LINE_RATE_RATIO = 0.45
"""Highest frequency of a line over the sample rate: a margin of a tenth to the Nyquist frequency."""

MIN_RECORDED_SHARE = 0.5
"""Share of a block's drive samples from which they determine its force: one of the two cycles that a block has at
least. Fewer do not separate the harmonics from the mean."""


class BlockDrive(NamedTuple):
    """One axis's drive, block by block.

    Attributes:
        reference: with knots at the switches. switches: their times, shape (switches,) [s].
        psi, w, force, drive_share: as in ``BlockSignal``, shape (blocks, ...).
    """

    reference: PhaseReference
    switches: Array
    psi: Array
    w: Array
    force: Complex
    drive_share: Array


def demodulate_drive(
    channel: Channel | None, reference: PhaseReference, time: Array, width: float, law: AxisParameters
) -> BlockDrive:
    """Reference and force in each block; no force if no drive was recorded.

    In a gap of the drive (NaN) the force is interpolated between the blocks beside it.

    Args:
        channel: the drive's voltage. time: middles of the blocks, shape (blocks,) [s]. width: of a block [s].

    Raises:
        BadInput: the drive does not cover the blocks.
    """
    psi, w = _linearise_reference(reference, time, time - 0.5 * width, time + 0.5 * width)
    if channel is None:
        silent = np.zeros((time.size, FORCE_HARMONICS), np.complex128)
        return BlockDrive(reference, np.empty(0), psi, w, silent, drive_shares(time))
    rate = channel.sample_rate
    length = round(width * rate)
    wanted = np.round((time - channel.start) * rate - 0.5 * (length - 1)).astype(np.int64)
    starts = np.clip(wanted, 0, channel.size - length)
    if channel.size < length or np.abs(starts - wanted).max() > length:
        raise not_covered(channel, "the signal of the motion", time[0] - 0.5 * width, time[-1] + 0.5 * width)
    orders = np.arange(1, FORCE_HARMONICS + 2)  # two more than are used, so that they do not leak into these
    orders = law.drive_order * orders[orders * law.drive_order * w.max() < 2 * np.pi * MAX_LINE_RATE_RATIO * rate]
    lines = np.stack([np.zeros_like(orders), orders], axis=1)
    squared = law.electrostatic_factor > 0.0
    projections = project_blocks(channel, starts, length, lines, w[:, None], squared=squared, may_clip=False)
    recorded = projections.counts >= MIN_RECORDED_SHARE * length
    switches = find_switch_times(channel, reference, starts, length, projections, orders, squared)
    if switches.size:
        reference = with_switches(reference, switches)
        pieces = block_pieces(starts, length, rate, channel.start, switches)
        low, high = channel.start + (starts + pieces[:, 0]) / rate, channel.start + (starts + pieces[:, 1] - 1) / rate
        psi, w = _linearise_reference(reference, time, low, high)
        projections = project_cut_blocks(
            projections, channel, starts, pieces, lines, w[:, None], squared, may_clip=False
        )
    delay = channel.start + (starts + 0.5 * (length - 1)) / rate - time
    fitted = least_squares_coefficients(projections)
    force = np.zeros((time.size, FORCE_HARMONICS), np.complex128)
    force[:, 0] = fitted[:, 0]
    for m in range(1, min(FORCE_HARMONICS, orders.size + 1)):
        rotation = np.exp(-1j * m * law.drive_order * (psi + w * delay))
        force[:, m] = (fitted[:, 2 * m - 1] - 1j * fitted[:, 2 * m]) * rotation
    return BlockDrive(reference, switches, psi, w, _without_gaps(force, recorded), drive_shares(time, switches))


def _without_gaps(force: Complex, recorded: NDArray[np.bool_]) -> Complex:
    """Harmonics of the force, shape (blocks, FORCE_HARMONICS), interpolated over the blocks that are not ``recorded``.

    They are relative to the reference, so that those of a drive that continues through the gap change little.
    """
    if recorded.all() or not recorded.any():
        return force
    block = np.arange(len(force))
    return np.stack([np.interp(block, block[recorded], line[recorded]) for line in force.T], axis=1)


def _linearise_reference(reference: PhaseReference, time: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """Linear approximation of the reference phase between ``low`` and ``high``, all of shape (blocks,) [s].

    Its mean is that of the reference (Simpson's rule), as a demodulation with a constant frequency measures a sweep.

    Returns:
        (phase at ``time`` [rad], rate [rad/s]).
    """
    before, middle, after = reference.phase(low), reference.phase(0.5 * (low + high)), reference.phase(high)
    w = (after - before) / (high - low)
    return (before + 4.0 * middle + after) / 6.0 + w * (time - 0.5 * (low + high)), w
