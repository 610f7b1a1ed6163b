"""End of a track, from which the next segment of the same recording is tracked without a new start."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from estimation.tracker.kalman_filter import StateEstimate
from estimation.tracker.observations import BlockLayout
from estimation.tracker.process_noise import NoisePosterior
from estimation.tracker.state_space import AXIS_STATES, PHASE
from scanner.arrays import Array
from scanner.channel import Channel
from scanner.motion import Motion

MAX_CLOCK_ERROR_SAMPLES = 0.01
"""Difference of a time from the nearest sample, in samples, up to which it is that of the sample."""

MAX_SKIPPED_BLOCKS = 4
"""Blocks before an earlier track's last one that a recording may begin with. Channels of axes with blocks of different
lengths end at different times."""

MIN_TUNED_SHARE = 0.75
"""Length of a segment over that of the one before below which it inherits the tuning: it tells less of the noise, and a
frame's short last part is to be tracked at once."""


class Tuning(NamedTuple):
    """Noise of a section, as in ``TunedSection``.

    Attributes:
        densities, posterior: of the process noise.
        noise_scale: factor on the noise variance of the blocks.
        offset_density: of the random walk of the readout's offset [V^2/s].
    """

    densities: Array
    posterior: NoisePosterior
    noise_scale: float
    offset_density: float


class TrackEnd(NamedTuple):
    """State of a sense channel's axes before the last block of a track.

    Attributes:
        start: time of the block's first sample [s]. length: of a block [samples].
        psi: reference phase of the axes in the block, shape (axes,) [rad]. w: its rate there [rad/s].
        prior: estimate before the block. signs: of the axes, as in ``AxisMotion``.
        tuning: of the track. blocks: in it.
    """

    start: float
    length: int
    psi: Array
    w: Array
    prior: StateEstimate
    signs: tuple[str, ...]
    tuning: Tuning
    blocks: int

    def inherited_tuning(self, blocks: int) -> Tuning | None:
        """The tuning for a segment of ``blocks``; None for one that is long enough to be tuned by itself."""
        return self.tuning if blocks < MIN_TUNED_SHARE * self.blocks else None


def end_of_track(layout: BlockLayout, prior: StateEstimate, signs: list[str], tuning: Tuning) -> TrackEnd:
    """The end of a track over all blocks of a layout; prior: before its last block."""
    channel = layout.sense.channel
    start = channel.start + int(layout.starts[-1]) / channel.sample_rate
    return TrackEnd(start, layout.length, layout.psi[-1], layout.w[-1], prior, tuple(signs), tuning, layout.starts.size)


def find_end(previous: Motion | None, channel: Channel) -> TrackEnd | None:
    """The end of an earlier track in a channel that begins at or before its last block; None if there is none."""
    end = None if previous is None else previous.ends.get(channel.name)
    if not isinstance(end, TrackEnd) or not np.isfinite(end.prior.mean).all():
        return None
    first = (end.start - channel.start) * channel.sample_rate
    aligned = abs(first - round(first)) < MAX_CLOCK_ERROR_SAMPLES
    return end if aligned and 0 <= round(first) <= MAX_SKIPPED_BLOCKS * end.length else None


def continued_prior(end: TrackEnd, layout: BlockLayout) -> StateEstimate:
    """The estimate before the first block of a layout, which is the last block of the earlier track.

    The phases are converted to the layout's references.
    """
    mean = end.prior.mean.copy()
    for a, change in enumerate(end.psi - layout.psi[0]):
        mean[a * AXIS_STATES + PHASE] += change
    return replace(end.prior, mean=mean)
