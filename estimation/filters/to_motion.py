"""From a filter's sample-by-sample state to a ``Motion``: slow phase and amplitude, and the angle made of them.

A filter's angle contains noise of the sense signal at each sample; a resonant mirror does not move at those
frequencies.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimation.filters.inputs import FilterInput
from estimation.reference import PhaseReference
from scanner.angle_tracks import SampledAngle
from scanner.arrays import Array, Complex
from scanner.channel import Channel
from scanner.errors import BadInput
from scanner.lock_in import block_phasors, slow_clock_block
from scanner.motion import UNKNOWN_PHASE_SD_RAD, AxisMotion

BLOCK_CYCLES = 4.0
"""Cycles of the motion per point of the slow clock: short against the ring-down of a resonator, long enough that the
third harmonic averages out."""

HANN_VARIANCE = 1.0 / 12.0 - 0.5 / np.pi**2
"""Variance of a Hann window as a density, in squares of its length."""

Clock = tuple[float, float, int]
"""Sample rate [Hz], time of the first sample [s] and number of samples."""


@dataclass(frozen=True)
class FilterOutput:
    """States of a filter and its likelihood.

    Attributes:
        theta: filtered angle, shape (axes, n) [rad].
        track: omega, var(theta), cov(theta, omega), var(omega) after every ``stride``-th step, shape (axes, m, 4).
        stride: steps between two points of the track.
        updates: number of measurements used.
        chi2: sum of squared normalised innovations.
        logdet: sum of the logarithms of the innovation variances.
    """

    theta: Array
    track: Array
    stride: int
    updates: int
    chi2: float
    logdet: float

    @property
    def log_likelihood(self) -> float:
        """Log likelihood of the sense signal, up to a constant."""
        return -0.5 * (self.chi2 + self.logdet)


def axis_motion_from_filter(
    problem: FilterInput, filtered: FilterOutput, i: int, name: str, clock: Clock
) -> AxisMotion:
    """The motion of one axis.

    Args:
        i: index of the axis in the filter; name: of the axis.
        clock: of the angle in the result.

    Raises:
        BadInput: the signal is shorter than two blocks.
    """
    channel, reference = problem.sense.channel, problem.references[name]
    f = reference.frequency
    block = slow_clock_block(f, channel.sample_rate, BLOCK_CYCLES, channel.size)
    time, means = block_phasors(filtered.theta[i], channel.sample_rate, channel.start, f, block)
    if time.size < 2:
        raise BadInput(
            f"is too short to determine the phase of axis {name}: {2 * block} samples are needed",
            file=channel.file,
            channel=channel.name,
            hint="record for longer",
        )
    mean_phase = reference.relative_phase(time, means)
    phasors = _at_centres(np.abs(means) * np.exp(1j * mean_phase))
    phase = mean_phase + np.angle(phasors * np.exp(-1j * mean_phase))
    phase += 2 * np.pi * np.round((problem.start.axes[name].phase - phase[0]) / (2 * np.pi))
    track_sample = np.arange(filtered.track.shape[1]) * filtered.stride + filtered.stride
    variance = _phase_variance(filtered.theta[i, track_sample], filtered.track[i], 2 * np.pi * f)
    block_of = np.minimum(track_sample // block, time.size - 1)
    count = np.maximum(np.bincount(block_of, minlength=time.size), 1)
    by_state, by_angle = (
        np.bincount(block_of, part, time.size) / count for part in (variance, filtered.track[i, :, 1])
    )
    # The phase of a block is that of the angles in it. Far below the resonance the filter hardly knows the velocity.
    variance = np.minimum(by_state, by_angle / np.square(np.abs(phasors)))
    return AxisMotion(
        time=time,
        phase=phase,
        amplitude=np.abs(phasors),
        frequency=reference.frequency_at(time) + np.gradient(phase, time) / (2 * np.pi),
        phase_sd=np.minimum(np.sqrt(variance), UNKNOWN_PHASE_SD_RAD),
        angle=synthesize_angle(filtered.theta[i], channel, reference, time, phase, np.abs(phasors), clock),
        reference=reference.kind,
        reference_frequency=reference.frequency,
        sign=problem.start.axes[name].sign,
    )


def _at_centres(means: Complex) -> Complex:
    """Phasors at the centres of blocks, from their means under a Hann window over each, both of shape (blocks,).

    The mean of a phasor that bends is beside its value in the centre by half of the second derivative times the
    variance of the window: 0.7 % of the amplitude in a decay with a Q of 20.
    """
    centres = means.copy()
    centres[1:-1] -= 0.5 * HANN_VARIANCE * np.diff(means, 2)
    return centres


def synthesize_angle(
    theta: Array,
    channel: Channel,
    reference: PhaseReference,
    knots: Array,
    phase: Array,
    amplitude: Array,
    clock: Clock,
) -> SampledAngle:
    """The angle A sin(psi + phi) of slow phase and amplitude, with the third harmonic that the torque adds.

    The third harmonic is about 0.1 % of A in a fixed relation to the fundamental; it is fitted to all of ``theta`` by
    least squares, so that a mirror at rest, where the rest of ``theta`` is noise, adds nothing to it.

    Args:
        theta: filtered angle at the samples of ``channel``, shape (n,) [rad].
        knots: times of the slow clock, shape (m,) [s]; phase, amplitude: at the knots, shape (m,) [rad].
        clock: of the result; NaN where ``channel`` does not reach.
    """

    def fundamental(time: Array) -> tuple[Array, Array]:
        return reference.phase(time) + _extrapolate(time, knots, phase), _extrapolate(time, knots, amplitude)

    total_phase, size = fundamental(channel.time())
    rest = theta - size * np.sin(total_phase)
    third = 2.0 * np.sum(size * rest * np.exp(-3j * total_phase)) / np.sum(size**2)
    rate, start, n = clock
    time = start + np.arange(n) / rate
    if (rate, start, n) != (channel.sample_rate, channel.start, channel.size):
        total_phase, size = fundamental(time)
    angle = size * (np.sin(total_phase) + np.abs(third) * np.cos(3.0 * total_phase + np.angle(third)))
    angle[(time < channel.start - 0.5 / rate) | (time > channel.end)] = np.nan
    return SampledAngle(angle, rate, start)


def _extrapolate(time: Array, knots: Array, values: Array) -> Array:
    """Linear interpolation, continued with the end's slope beyond the knots."""
    first, last = ((values[i + 1] - values[i]) / (knots[i + 1] - knots[i]) for i in (0, -2))
    inside = np.interp(time, knots, values)
    return inside + np.minimum(time - knots[0], 0.0) * first + np.maximum(time - knots[-1], 0.0) * last


def _phase_variance(theta: Array, track: Array, rate: float) -> Array:
    """Variance of the instantaneous phase atan2(rate theta, omega), from the state's covariance [rad2]."""
    quadrature = track[:, 0] / rate
    square = theta**2 + quadrature**2
    variance = quadrature**2 * track[:, 1] - 2 * theta * quadrature * track[:, 2] / rate
    return (variance + theta**2 * track[:, 3] / rate**2) / square**2
