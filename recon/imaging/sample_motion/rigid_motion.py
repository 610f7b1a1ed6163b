"""Rigid motion of the sample during a scan, estimated at the crossings of the scan path.

1. At rest: the equations of each block around no motion (``block_equations``), and the likelihood of a walk
   and of vibrations over rest (``motion_smoother``). Without a gain of ``MIN_LOG_LIKELIHOOD_GAIN``, here, in step 3
   or in step 4, nothing is reported.
2. Coarse: parts of ``SEARCH_PERIODS`` by exhaustive comparison (``coarse_search``).
3. Fine: Gauss-Newton over blocks of one period of the slower axis. Every round maps the samples with the present
   motion, and smooths the equations of all blocks. The kernel is the one that predicts best after the search: a wider
   one would blur a lattice of its width, and with it the difference between the periods.
4. Predicted: the log likelihood of the samples under the picture of the other blocks, with the motion and at rest. The
   gain of the rounds is that of equations around the motion, and the picture follows the motion: detail of few beads
   or of a lattice can agree with it. A motion that is not there blurs the picture, which then predicts less well
   (cross-validation; Stone 1974, "Cross-validatory choice and assessment of statistical predictions").
5. Left: the variance of a motion that both halves of the scene show after that (``residual``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from recon.imaging.sample_motion.block_equations import PARTS, PLACE_PX, block_equations, sample_log_likelihoods
from recon.imaging.sample_motion.coarse_search import search_motion
from recon.imaging.sample_motion.jumps import MotionKnots, place_jumps
from recon.imaging.sample_motion.motion_smoother import SmoothedMotion, part_shift, smooth_motion
from recon.imaging.sample_motion.placed_samples import PlacedSamples
from recon.imaging.sample_motion.residual import remaining_motion_variance
from recon.imaging.sample_motion.vibrations import Vibration, vibration_shift
from scanner.arrays import Array
from scanner.channel import Channel

SEARCH_PERIODS = 12
"""Periods of the slower axis in a part of the coarse search: fewer visit too little of the picture."""

WIDTHS_PX = (0.7, 1.0, 1.4, 2.0, 2.8, 4.0)
"""Kernels that are compared [px]. Below 0.7 the gradient is that of single pixels."""

MAX_ROUNDS = 8
"""Rounds at most; three or four are usual."""

CONVERGED_SD = 0.1
"""Change of the motion, in its standard deviations, below which the rounds end."""

MIN_LOG_LIKELIHOOD_GAIN = 10.0
"""Gain of the log likelihood from which a motion is reported. Chance exceeds it with a probability of exp(-10) = 5e-5
for the two variances of the walk (Wilks 1938)."""

MIN_BLOCKS = 16
"""Least number of blocks: with fewer the noise of the equations is not known."""

MIN_CELLS_ACROSS = 2 * PLACE_PX
"""Least number of rows and of columns of cells: with less than two places across, sums over places are of too few to
determine a variance. In pictures of 4 to 8 rows some samples at rest had one."""

MIN_INFORMATION = 1e-8
"""Information on a position in a scene without structure [1/px²]: the field is narrower than 10^4 pixels."""

MIN_COMPARED = 0.5
"""Fraction of the samples that need samples of other blocks within reach of the narrowest kernel, at crossings."""


@dataclass(frozen=True)
class SampleMotion:
    """Translation of the sample over time; its mean over the recording is 0.

    Attributes:
        length: samples in a block, a period of the slower axis.
        sample: sample numbers of the knots between which the displacement is linear: the middles of blocks, of their
            parts where the sample vibrates, and two knots at each jump, shape (knots,).
        shift: x and y at the knots, shape (knots, 2) [px]; 0 for a sample at rest.
        sd: of ``shift``, shape (knots, 2) [px]; for a sample at rest that of the position of a single block.
        moving: whether a motion was found.
        gain: of the log likelihood by the motion over rest, the least of steps 1, 3 and 4.
        left: standard deviation of a motion in x and y that was not followed, shape (2,) [px]; 0 where none is
            significant. ``sd`` contains it.
        vibrations: that were found; frequencies in cycles per sample, amplitudes in pixels.
    """

    length: int
    sample: Array
    shift: Array
    sd: Array
    moving: bool
    gain: float
    left: Array
    vibrations: tuple[Vibration, ...]

    def times(self, intensity: Channel) -> Array:
        """Times of the knots on the clock of the intensity that the motion was estimated from, shape (knots,) [s]."""
        return np.asarray(intensity.start + self.sample / intensity.sample_rate)

    def at(self, sample: Array) -> Array:
        """Displacement at sample numbers, shape (2, n) [px]."""
        return np.stack([np.interp(sample, self.sample, each) for each in self.shift.T])


def estimate_sample_motion(
    samples: PlacedSamples, period: float, shape: tuple[int, int], widths: Sequence[float] = WIDTHS_PX
) -> SampleMotion | None:
    """Estimate the motion of the sample; None where the scan has too few crossings or cells across.

    Args:
        samples: of the scan.
        period: of the slower axis [samples].
        shape: height and width of the picture [px].
        widths: of the kernels that are compared at rest, ascending [px].
    """
    part = max(round(period / PARTS), 1)
    length = part * PARTS
    blocks = -(-samples.x.size // length)
    if blocks < MIN_BLOCKS or min(shape) < MIN_CELLS_ACROSS:
        return None
    position = np.zeros((blocks, 2))
    at_rest = part_shift(position, [])
    width, compared = choose_width(samples, at_rest, part, shape, widths)
    if compared < MIN_COMPARED:
        return None
    equations = block_equations(samples, at_rest, part, shape, width)
    first = final = smooth_motion(equations, position, jumps=False)
    final_width = width
    if first.gain >= MIN_LOG_LIKELIHOOD_GAIN:
        start = first._replace(position=_coarse_motion(samples, length, blocks, shape), vibrations=[])
        final, final_width = _follow(samples, start, part, shape)
    gain = min(first.gain, final.gain)
    if gain >= MIN_LOG_LIKELIHOOD_GAIN:
        gain = min(gain, _prediction_gain(samples, part, shape, final_width, final.shift, at_rest))
    moving = gain >= MIN_LOG_LIKELIHOOD_GAIN
    if moving:
        knots, shift, vibrations = place_jumps(samples, final, part, shape, final_width), final.shift, final.vibrations
    else:
        middle: Array = np.asarray((np.arange(blocks) + 0.5) * length - 0.5, np.float64)
        information = equations.information[:, :2, :2].mean(axis=0) + MIN_INFORMATION * np.eye(2)
        sd_of_a_block = np.sqrt(first.motion.scale * np.diag(np.linalg.inv(information)))
        knots, shift, vibrations = MotionKnots(middle, position, np.tile(sd_of_a_block, (blocks, 1))), at_rest, []
    left = remaining_motion_variance(samples, shift, part, shape, final_width if moving else width)
    sample, displacement, sd = (each[knots.sample < samples.x.size] for each in knots)  # the last block may be cut off
    per_sample = tuple(each._replace(frequency=each.frequency / length) for each in vibrations)
    return SampleMotion(length, sample, displacement, np.sqrt(sd**2 + left), moving, gain, np.sqrt(left), per_sample)


def choose_width(
    samples: PlacedSamples, shift: Array, part: int, shape: tuple[int, int], widths: Sequence[float] = WIDTHS_PX
) -> tuple[float, float]:
    """Return the kernel [px] whose picture of the other blocks predicts the samples best.

    The fraction of the samples that the narrowest kernel compares with others is returned too.
    """
    found = [block_equations(samples, shift, part, shape, width) for width in widths]
    return widths[int(np.argmin([each.misfit for each in found]))], found[0].compared


def _prediction_gain(
    samples: PlacedSamples, part: int, shape: tuple[int, int], width: float, moved: Array, without: Array
) -> float:
    """Gain of the log likelihood of the samples under the pictures of the other blocks, at least 0.

    Args:
        samples, part, shape: as for :func:`choose_width`.
        width: of the kernel [px].
        moved, without: displacement of each part, shape (blocks * PARTS, 2) [px].
    """
    after, before = (sample_log_likelihoods(samples, shift, part, shape, width) for shift in (moved, without))
    return max(float(np.nansum(after - before, dtype=np.float64)), 0.0)


def _follow(
    samples: PlacedSamples, start: SmoothedMotion, part: int, shape: tuple[int, int]
) -> tuple[SmoothedMotion, float]:
    """The motion after rounds of Gauss-Newton from a coarse one, and the kernel [px] of the last ones.

    Vibrations that do not predict the samples better than the motion without them are excluded. Then the rounds are
    repeated, unless nothing is left that does.
    """
    width, _ = choose_width(samples, start.shift, part, shape)
    excluded: list[float] = []

    def predicts(moved: Array, without: Array) -> bool:
        return _prediction_gain(samples, part, shape, width, moved, without) >= MIN_LOG_LIKELIHOOD_GAIN

    while True:
        smoothed = _converge(samples, start, part, shape, width, excluded)
        blocks, shift = len(smoothed.position), smoothed.shift
        vibrations = [(each, vibration_shift([each], blocks)) for each in smoothed.vibrations]
        failed = [each for each, vibrating in vibrations if not predicts(shift, shift - vibrating)]
        if not failed:
            return smoothed, width
        walk = part_shift(smoothed.position, [])
        if len(failed) == len(vibrations) and not predicts(walk, np.zeros_like(walk)):
            return smoothed, width
        excluded += [each.frequency for each in failed]
        start = smoothed


def _converge(
    samples: PlacedSamples,
    smoothed: SmoothedMotion,
    part: int,
    shape: tuple[int, int],
    width: float,
    excluded: Sequence[float],
) -> SmoothedMotion:
    """The motion after rounds of Gauss-Newton, without vibrations near excluded frequencies [cycles per block]."""
    for _ in range(MAX_ROUNDS):
        before = smoothed
        smoothed = _round(samples, before, part, shape, width, excluded)
        variance = np.einsum("bpii->bpi", smoothed.covariance()).mean()
        if np.mean((smoothed.shift - before.shift) ** 2) < CONVERGED_SD**2 * variance:
            break
    return smoothed


def _round(
    samples: PlacedSamples,
    around: SmoothedMotion,
    part: int,
    shape: tuple[int, int],
    width: float,
    excluded: Sequence[float],
) -> SmoothedMotion:
    """A step of Gauss-Newton, without the mean, which no sample determines."""
    found = block_equations(samples, around.shift, part, shape, width)
    smoothed = smooth_motion(found, around.position, around.vibrations, around, excluded=excluded)
    return smoothed._replace(position=smoothed.position - smoothed.position.mean(axis=0))


def _coarse_motion(samples: PlacedSamples, length: int, blocks: int, shape: tuple[int, int]) -> Array:
    """Translation of each block by the coarse search, linear between the middles of its parts."""
    parts = max(blocks // SEARCH_PERIODS, 1)
    coarse = search_motion(samples, SEARCH_PERIODS * length, parts, shape)
    middle = SEARCH_PERIODS * (np.arange(parts) + 0.5)
    return np.column_stack([np.interp(np.arange(blocks) + 0.5, middle, each) for each in coarse.T])
