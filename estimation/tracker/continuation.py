"""End of a track, from which the next segment of the same recording is tracked without a new start."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from estimation.tracker.demodulation import NoiseSpectrum
from estimation.tracker.kalman_filter import StateEstimate
from estimation.tracker.observations import BlockLayout
from estimation.tracker.process_noise import NoisePosterior
from estimation.tracker.readout_curve import ReadoutCurve
from estimation.tracker.state_space import AXIS_STATES, PHASE
from scanner.arrays import Array
from scanner.channel import Channel
from scanner.motion import Motion

MAX_CLOCK_ERROR_SAMPLES = 0.01
"""Difference of a time from the nearest sample, in samples, up to which it is that of the sample."""

MAX_SKIPPED_BLOCKS = 4
"""Blocks before an earlier track's last one that a recording may begin with. Channels of axes with blocks of different
lengths end at different times."""

MIN_TUNED_SHARE = 0.9
"""Length of a segment over that of the one in which the tuning was determined, below which it inherits the tuning: it
determines the noise less well, and tuning takes a third of the time of a short segment. The first parts of successive
frames are equally long to within some percent, by which the frequency that determines it may drift."""


class Tuning(NamedTuple):
    """Noise of a section, as in ``TunedSection``.

    Attributes:
        densities, posterior: of the process noise.
        noise_scale: factor on the noise variance of the blocks.
        offset_density: of the random walk of the readout's offset [V^2/s].
        spectrum: of the noise of the blocks' projections.
        curves: of the readout, in the order in which the channel was straightened.
    """

    densities: Array
    posterior: NoisePosterior
    noise_scale: float
    offset_density: float
    spectrum: NoiseSpectrum
    curves: tuple[ReadoutCurve, ...] = ()


class TrackEnd(NamedTuple):
    """State of a sense channel's axes before the last block of a track.

    Attributes:
        start: time of the block's first sample [s]. length: of a block [samples].
        psi: reference phase of the axes in the block, shape (axes,) [rad]. w: its rate there [rad/s].
        prior: estimate before the block. signs: of the axes, as in ``AxisMotion``.
        tuning: of the track. tuned_blocks: from which it was determined.
    """

    start: float
    length: int
    psi: Array
    w: Array
    prior: StateEstimate
    signs: tuple[str, ...]
    tuning: Tuning
    tuned_blocks: int

    def inherited_tuning(self, layout: BlockLayout) -> Tuning | None:
        """The tuning for a segment; None for one that is long enough to be tuned by itself, or has other lines."""
        short = layout.starts.size < MIN_TUNED_SHARE * self.tuned_blocks
        same = layout.length == self.length and self.tuning.spectrum.excess.size == 1 + 2 * len(layout.lines)
        return self.tuning if short and same else None


def end_of_track(
    layout: BlockLayout, prior: StateEstimate, signs: list[str], tuning: Tuning, tuned_blocks: int
) -> TrackEnd:
    """The end of a track over all blocks of a layout; prior: before its last block."""
    channel = layout.sense.channel
    start = channel.start + int(layout.starts[-1]) / channel.sample_rate
    return TrackEnd(start, layout.length, layout.psi[-1], layout.w[-1], prior, tuple(signs), tuning, tuned_blocks)


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
