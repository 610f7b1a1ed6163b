"""Vibrations of the sample: sinusoids beside its walk, found by their likelihood.

A vibration of frequency f has a cosine and a sine in x and y, which enter the equations of the displacement linearly.
The reduction of the squared residuals by each f is a generalised periodogram: the Fourier transform of the scores that
the walk leaves, in the metric of their covariance. The equations of one registration serve all frequencies. The largest
peak is refined by Gauss-Newton steps in its frequency. It is accepted if noise reaches its gain at any frequency with a
probability below exp(``LOG_MAX_FALSE_ALARM``), with the variance of the likelihood and with that from sums by place
(``block_equations``). Then the next one is searched in what is left.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.fft import fft, next_fast_len

from recon.imaging.sample_motion.block_equations import PARTS, SHAPES, BlockEquations, by_shape
from recon.imaging.sample_motion.motion_filter import (
    VELOCITY_WALKS_PX,
    WALKS_PX,
    Data,
    MotionUnderWalk,
    Observations,
    climb,
)
from scanner.arrays import Array

MAX_FREQUENCY = 0.75
"""Highest frequency that is searched [cycles per block]. Near 1 the displacement becomes one of the phase and amplitude
of the slower axis, which are free in each block: of the information of a slow motion along it, a fifth is left here.
"""

MIN_CYCLES = 4.0
"""Fewest cycles in the recording: the walk follows slower motions."""

MIN_CYCLES_APART = 1.0
"""Least difference of two frequencies in cycles in the recording: sinusoids of nearer ones are alike, so that large
amplitudes of opposite signs would fit a small displacement."""

OVERSAMPLING = 4
"""Frequencies that are compared, per inverse duration. The peak is at most an eighth off: 2.5 % of its gain is lost."""

LOG_MAX_FALSE_ALARM = -10.0
"""Logarithm of the probability below which chance is to reach the gain of a vibration at any frequency: 5e-5, as for
the walk."""

MAX_VIBRATIONS = 20
"""Limit on the number of vibrations, and so of the computing time."""

REFINEMENTS = 3
"""Gauss-Newton steps of the frequency: the first error is an eighth of a cycle in the recording."""

AMPLITUDE_SD_PX = 5.0
"""Standard deviation of an amplitude before the recording [px]: half of the 10 pixels that are to be followed. It only
matters in a direction in which the scene does not change."""

PHASE_SD = 1.0
"""Standard deviation of the error of the phase at the ends of the recording by that of the frequency [rad]: the
spacing of the frequencies that are compared allows 0.4."""


class Vibration(NamedTuple):
    """A sinusoid about the middle of the recording.

    Attributes:
        frequency: [cycles per block].
        cosine, sine: amplitudes in x and y, shape (2,) [px].
    """

    frequency: float
    cosine: Array
    sine: Array

    @property
    def peak(self) -> Array:
        """Peaks in x and y, shape (2,) [px]."""
        return np.hypot(self.cosine, self.sine)


def vibration_shift(vibrations: Sequence[Vibration], blocks: int) -> Array:
    """Return the sum of vibrations in the middle of each part, shape (blocks * PARTS, 2) [px]."""
    shift = np.zeros((blocks * PARTS, 2))
    for each in vibrations:
        angle = 2.0 * np.pi * each.frequency * _times(blocks)
        shift += np.outer(np.cos(angle), each.cosine) + np.outer(np.sin(angle), each.sine)
    return shift


def observe(data: Data, vibrations: Sequence[Vibration]) -> Observations:
    """Return the observations with the amplitudes and the error of the frequency of each vibration as free values."""
    blocks = len(data.weighted)
    columns = np.concatenate([_columns(each, blocks) for each in vibrations] or [np.zeros((blocks, PARTS, 2, 0))], -1)
    precision = np.tile([*[AMPLITUDE_SD_PX**-2] * 4, PHASE_SD**-2], len(vibrations))
    return Observations.of(data, columns, precision)


def find_vibrations(
    equations: BlockEquations,
    around: Array,
    variance: Array,
    start: tuple[int, int] | None,
    excluded: Sequence[float] = (),
) -> tuple[tuple[int, int], list[Vibration], float]:
    """Return walk, vibrations and log likelihood, the vibrations being found one after the other.

    Args:
        equations: of the displacement.
        around: displacement of each part in the equations, shape (blocks, PARTS, 2) [px].
        variance: of the jump before each block, shape (blocks,) [px²].
        start: numbers of a walk near the most likely one.
        excluded: frequencies that are not searched [cycles per block].
    """
    data, blocks = Data.around(equations, by_shape(around)), len(around)
    found: list[Vibration] = []
    rejected: list[float] = []
    walk, best = climb(observe(data, found), variance, start)
    while len(found) + len(rejected) < MAX_VIBRATIONS:
        unused = [*excluded, *rejected, *(each.frequency for each in found)]
        candidate = _strongest(data, observe(data, found), walk, variance, unused)
        if candidate is None:
            break
        trial = refine_vibrations(data, [*found, candidate], walk, variance)
        its_walk, likelihood = climb(observe(data, trial), variance, walk)
        if log_false_alarm(likelihood - best, blocks) > LOG_MAX_FALSE_ALARM:
            break
        motion = observe(data, trial).smoothed(its_walk, variance)
        own = slice(-5, -1)  # the amplitudes of the candidate
        covariance = coefficient_covariance(equations, motion, around)[own, own]
        amplitudes = motion.coefficients[own]
        gain = 0.5 * float(amplitudes @ np.linalg.solve(covariance, amplitudes))
        apart = np.diff(np.sort([each.frequency for each in trial])) * blocks
        if log_false_alarm(gain, blocks) > LOG_MAX_FALSE_ALARM or np.any(apart < MIN_CYCLES_APART):
            rejected.append(candidate.frequency)
            continue
        walk, found, best = its_walk, trial, likelihood
    return walk, found, best


def refine_vibrations(
    data: Data, vibrations: list[Vibration], walk: tuple[int, int], variance: Array
) -> list[Vibration]:
    """Return the vibrations after Gauss-Newton steps, for the walk and the variance of the jumps."""
    blocks = len(data.weighted)
    for _ in range(REFINEMENTS):
        values = observe(data, vibrations).coefficients(walk, variance).reshape(-1, 5)
        vibrations = [
            Vibration(each.frequency + value[4] / (np.pi * blocks), value[:2], value[2:4])
            for each, value in zip(vibrations, values, strict=True)
        ]
    return vibrations


def coefficient_covariance(equations: BlockEquations, motion: MotionUnderWalk, around: Array) -> Array:
    """Return the covariance of the amplitudes and frequencies, from sums by place, shape (k, k).

    Args:
        equations: of the displacement.
        motion: that was fitted to them.
        around: displacement of each part in the equations, shape (blocks, PARTS, 2) [px].
    """
    change = motion.displacement - around
    return np.asarray(motion.inverse @ equations.scatter(motion.free, change.reshape(-1, 2)) @ motion.inverse)


def log_false_alarm(gain: float, blocks: int) -> float:
    """Return the logarithm of the probability that noise reaches a gain of the log likelihood at any frequency.

    Twice the gain of four amplitudes is chi-square; its rate of upcrossings over the frequency is that of Davies
    (1987, "Hypothesis testing when a nuisance parameter is present only under the alternative") for a duration of
    uniform information (Baluev 2008, "Assessing the statistical significance of periodogram peaks").

    Args:
        gain: of the log likelihood by a vibration.
        blocks: in the recording.
    """
    if gain <= 1.5:  # the maximum of the expression
        return 0.0
    return float(min(np.log(np.sqrt(np.pi / 3.0) * MAX_FREQUENCY * blocks) + 1.5 * np.log(gain) - gain, 0.0))


def _times(blocks: int) -> Array:
    """Middles of the parts from the middle of the recording, shape (blocks * PARTS,) [blocks]."""
    return np.asarray((np.arange(blocks * PARTS) + 0.5) / PARTS - 0.5 * blocks)


def _columns(vibration: Vibration, blocks: int) -> Array:
    """Displacement by each free value of a vibration, shape (blocks, PARTS, 2, 5).

    The last one is the error of its phase at the end of the recording, in proportion to the time.
    """
    time = _times(blocks)
    angle = 2.0 * np.pi * vibration.frequency * time
    cosine, sine = np.cos(angle), np.sin(angle)
    columns = np.zeros((time.size, 2, 5))
    for axis in range(2):
        columns[:, axis, axis], columns[:, axis, 2 + axis] = cosine, sine
        slope = vibration.sine[axis] * cosine - vibration.cosine[axis] * sine
        columns[:, axis, 4] = slope * time / (0.5 * blocks)
    return columns.reshape(blocks, PARTS, 2, 5)


def _strongest(
    data: Data, observed: Observations, walk: tuple[int, int], variance: Array, excluded: Sequence[float]
) -> Vibration | None:
    """The frequency of the largest gain of the likelihood, with amplitudes of 0; None without information.

    Frequencies too near to excluded ones are left out. The information at a frequency is the mean of
    the blocks, less what the walk takes of it.
    """
    blocks = len(data.weighted)
    motion = observed.smoothed(walk, variance)
    shift = by_shape(motion.displacement)
    left = data.weighted - np.einsum("bij,bj->bi", data.information, shift)
    size = next_fast_len(OVERSAMPLING * blocks)
    first = int(np.ceil(MIN_CYCLES * size / blocks))
    number = np.arange(first, int(MAX_FREQUENCY * size) + 1)
    frequency = number / size
    shapes = np.exp(2j * np.pi * np.outer(frequency, np.arange(PARTS)) / PARTS) @ SHAPES.T / PARTS
    spectrum = np.einsum(
        "fka,fk->fa", fft(left, size, axis=0)[number % size].reshape(-1, len(SHAPES), 2), shapes.conj()
    )
    mean = data.information.mean(axis=0).reshape(len(SHAPES), 2, len(SHAPES), 2)
    step = 4.0 * np.sin(np.pi * frequency) ** 2
    walked = (WALKS_PX[walk[0]] ** 2 / step + VELOCITY_WALKS_PX[walk[1]] ** 2 / step**2)[:, None, None]
    along = np.einsum("fj,jakc->fakc", shapes.conj(), mean)
    taken = walked * along[..., 0, :] @ np.linalg.inv(np.eye(2) + walked * mean[0, :, 0])
    information = np.einsum("fakc,fk->fac", along, shapes) - taken @ np.swapaxes(along[..., 0, :].conj(), 1, 2)
    noise = np.linalg.pinv(information, rcond=1e-6, hermitian=True)
    gain = np.einsum("fa,fac,fc->f", spectrum.conj(), noise, spectrum).real
    for each in excluded:
        gain[np.abs(frequency - each) * blocks < MIN_CYCLES_APART] = 0.0
    if not gain.size or not gain.max() > 0.0:
        return None
    return Vibration(float(frequency[np.argmax(gain)]), np.zeros(2), np.zeros(2))
