"""Process noise: how fast the resonance drifts, estimated from the recording itself, and its posterior distribution.

Four spectral densities of each axis are tuned: of white noise on the rates of phase and ln A [rad^2/s], of the
stiffness's rate [1/s^3], of the damping [1/s] and of the logarithm of the readout gain [1/s]. A fifth one is that of
the readout's offset [V^2/s]. The mean of the signal depends on the amplitude of a comb's motion: hum or 1/f noise that
the offset may not follow would be attributed to the amplitude.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from estimation.tracker import rts_smoother
from estimation.tracker.block_signal import MIN_OFFSET_DENSITY_V2_PER_S, BlockSignal
from estimation.tracker.filter_run import filter_blocks, select_blocks
from estimation.tracker.kalman_filter import StateEstimate
from estimation.tracker.linearisation import Linearisation, empty_linearisation
from estimation.tracker.observations import BlockObservations
from estimation.tracker.state_space import AXIS_STATES, DAMPING, GAIN, LOG_AMPLITUDE, PHASE, STIFFNESS_RATE, padded_size
from scanner.arrays import Array

INITIAL_DENSITIES = (1e-7, 0.1, 1e-5, 1e-6)
"""Densities at which the tuning starts. 0.1 / s^3 is a stiffness drift of 0.1 % in 30 ms, usual while warming up."""

MIN_DENSITIES = (1e-9, 1e-4, 1e-8, 1e-8)
"""Least densities: 1e-4 / s^3 is a stiffness drift of 0.003 % in 30 ms. They keep the covariance regular."""

MAX_DENSITIES = (1.0, 100.0, 1.0, 1.0)
"""Largest densities: a thousand times those of a scanner that warms up. Beyond, the filter would follow the noise."""

MAX_TUNING_BLOCKS = 300
"""Blocks on which the densities are tuned, in up to three parts: with more, the tuning would dominate the run time."""

MAX_TUNING_ROUNDS = 12
"""Most rounds of the tuning; the densities may grow by MAX_DENSITY_GROWTH in each."""

LOG_DENSITY_TOLERANCE = 0.2
"""Change of the logarithm of a density at which the tuning ends: its standard deviation at 50 degrees of freedom."""

MIN_INFORMATIVE_DOF = 1e-3
"""Degrees of freedom of a disturbance in the data below which its density is left unchanged."""

PRIOR_DOF = (0.0, 1.0, 0.0, 0.0)
"""Degrees of freedom that the prior adds to each density's score: one for a prior that is flat in the square root."""

OFFSET_PRIOR_DOF = 1.0
"""Degrees of freedom of the prior of the offset's density, about the thermal drift MIN_OFFSET_DENSITY_V2_PER_S: as many
as the prior of the stiffness rate has. Without it, noise would be attributed to an offset that is at rest."""

MIN_CHANGE_SDS = 3.0
"""Difference of the signal's mean between two halves of the blocks, in standard deviations by the scatter from block to
block, from which on the mean changes: 0.3 % of noise exceeds it."""

MIN_BLOCKS_OF_CHANGE = 6
"""Blocks from which on their scatter is known to a third."""

MAX_DENSITY_GROWTH = 10.0
"""Largest factor by which a density grows in a round; keeps the fixed-point iteration stable."""

STIFFNESS_RATE_COLUMN = 1
"""Index of the stiffness rate's density among the four."""

NODE_SPACING_LOG = 2.0
"""Spacing, in ln q, of the densities q at which the posterior is evaluated.

At 0 dB a scan of 30 ms has one to three degrees of freedom, a standard deviation of 0.8 to 1.4 in ln q.
"""

MIN_KNOWN_DOF = 30.0
"""Degrees of freedom from which a density counts as known: its relative standard deviation is then 0.26."""

POSTERIOR_POINTS = 201
"""Points at which the posterior of ln q is integrated; 0.02 apart."""


class TuningPart(NamedTuple):
    """Consecutive blocks of a signal, with their linearisations, which all runs over them share."""

    signal: BlockSignal
    linear: Linearisation


class NoisePosterior(NamedTuple):
    """Posterior distribution of the process noise at a few nodes. Tracks are interpolated linearly between the nodes.

    Attributes:
        densities: at the nodes, shape (nodes, axes, 4).
        mean_weights: posterior mean of each node's interpolation weight, shape (axes, nodes).
        weight_products: posterior mean of the products of two weights, shape (axes, nodes, nodes).
    """

    densities: Array
    mean_weights: Array
    weight_products: Array


def tune_process_noise(
    observations: BlockObservations, start: StateEstimate, parts: list[TuningPart], densities: Array | None = None
) -> tuple[Array, float]:
    """Most probable spectral densities of the process noise, shape (axes, 4), and of the offset [V^2/s].

    For a density q, step h and the sums R = sum of r^2 and N of ``disturbance_scores``, the derivative of the
    log-likelihood by ln q is (q h R - q h N) / 2. The prior adds (a - b) / 2. The iteration q <- q (q h R + a) /
    (q h N + b) has its fixed point where the sum vanishes. A density with less than one degree of freedom q h N in the
    data and no prior does not delay the end.
    The prior of the stiffness rate is flat in its standard deviation: a = 1, b = 0 (Gelman, Bayesian Analysis 1, 515,
    2006). Without it, a likelihood that is flat towards zero drift would often yield none. That of the offset is a
    scaled inverse chi-square distribution with OFFSET_PRIOR_DOF degrees of freedom n about the thermal drift q0:
    a = n q0 / q, b = n.

    Args:
        start: estimate before the first block of each part. parts: blocks to tune on.
        densities: to start from, shape (axes, 4); INITIAL_DENSITIES if None.
    """
    step, axes = observations.signal.step, len(observations.parameters)
    densities = np.tile(INITIAL_DENSITIES, (axes, 1)) if densities is None else densities
    added, removed = np.append(np.tile(PRIOR_DOF, axes), 0.0), np.append(np.zeros(4 * axes), OFFSET_PRIOR_DOF)
    idle = added == 0.0  # densities that the prior does not keep from their least value
    idle[-1] = True
    low, high = (
        np.append(np.tile(limits, axes), offset)
        for limits, offset in ((MIN_DENSITIES, MIN_OFFSET_DENSITY_V2_PER_S), (MAX_DENSITIES, np.inf))
    )
    q = np.append(densities, observations.signal.offset_density)
    for _ in range(MAX_TUNING_ROUNDS):
        parts = with_offset_density(parts, q[-1])
        added[-1] = OFFSET_PRIOR_DOF * MIN_OFFSET_DENSITY_V2_PER_S / q[-1]
        squares, information = _score_terms(observations, parts, start, q[:-1].reshape(axes, -1))
        dof = information * q * step
        informative = dof + removed > MIN_INFORMATIVE_DOF
        fixed_point = q * (squares * q * step + added) / np.where(informative, dof + removed, 1.0)
        limited = np.clip(np.minimum(fixed_point, MAX_DENSITY_GROWTH * q), low, high)
        new = np.where(informative, limited, q)
        converged = np.abs(np.log(new / q)) < LOG_DENSITY_TOLERANCE
        converged |= (dof < 1.0) & idle
        q = new
        if converged.all():
            break
    return q[:-1].reshape(axes, -1), float(q[-1])


def tune_between_motion_and_offset(
    observations: BlockObservations, start: StateEstimate, parts: list[TuningPart], densities: Array
) -> tuple[Array, float]:
    """As ``tune_process_noise``, from two densities of the offset: the more probable result.

    A change of the signal's mean is explained by the offset, or by an amplitude whose change the gain hides in the
    harmonics. The tuning keeps the explanation that its start favours. It therefore starts from the observations' own
    density of the offset, which leaves a steady drift of the mean to the motion, and from ``whole_mean_density``.
    """
    starts = [observations.signal.offset_density]
    whole = max(whole_mean_density(part.signal) for part in parts)
    if whole > starts[0]:
        starts.append(whole)
    found = []
    for density in starts:
        begun = observations.with_offset_density(density)
        result = tune_process_noise(begun, start, with_offset_density(parts, density), densities)
        found.append((_log_posterior(observations, start, parts, *result), result))
    return max(found, key=lambda each: each[0])[1]


def whole_mean_density(signal: BlockSignal) -> float:
    """Density of the offset's walk that explains every change of the signal's mean from block to block [V^2/s].

    The least one where the means of both halves of the blocks differ by no more than their scatter: the mean is steady.
    """
    used = np.isfinite(signal.noise_var)
    means = np.einsum("kj,kj->k", signal.solvers[signal.geometry[used], 0], signal.whitened[used])
    if means.size < MIN_BLOCKS_OF_CHANGE:
        return MIN_OFFSET_DENSITY_V2_PER_S
    increments, (first, last) = np.diff(means), np.array_split(means, 2)
    error = np.sqrt(0.5 * np.var(increments) * (1.0 / first.size + 1.0 / last.size))
    if abs(last.mean() - first.mean()) < MIN_CHANGE_SDS * error:
        return MIN_OFFSET_DENSITY_V2_PER_S
    return max(float(np.mean(increments**2)) / signal.step, MIN_OFFSET_DENSITY_V2_PER_S)


def _log_posterior(
    observations: BlockObservations,
    start: StateEstimate,
    parts: list[TuningPart],
    densities: Array,
    offset_density: float,
) -> float:
    """Logarithm of likelihood times prior of the densities' logarithms, see ``tune_process_noise``."""
    parts = with_offset_density(parts, offset_density)
    likelihood = sum(filter_blocks(observations, *part, start, densities).log_likelihood for part in parts)
    ratio = offset_density / MIN_OFFSET_DENSITY_V2_PER_S
    prior = 0.5 * float(np.sum(np.log(densities) * PRIOR_DOF))
    return likelihood + prior - 0.5 * OFFSET_PRIOR_DOF * (np.log(ratio) + 1.0 / ratio)


def with_offset_density(parts: list[TuningPart], density: float) -> list[TuningPart]:
    """The parts with another spectral density of the readout's offset [V^2/s]."""
    return [part._replace(signal=part.signal._replace(offset_density=float(density))) for part in parts]


def _score_terms(
    observations: BlockObservations, parts: list[TuningPart], start: StateEstimate, densities: Array
) -> tuple[Array, Array]:
    """Sums of r^2 and of N by density, see ``rts_smoother.disturbance_scores``, each of shape (4 axes + 1,)."""
    squares, information = np.zeros((2, padded_size(start.mean.size)))
    for part in parts:
        run = filter_blocks(observations, *part, start, densities)
        terms = rts_smoother.disturbance_scores(*part, run.history)
        squares, information = np.add((squares, information), terms)
    return _sum_by_density(squares, len(densities)), _sum_by_density(information, len(densities))


def mean_nis(observations: BlockObservations, start: StateEstimate, parts: list[TuningPart], densities: Array) -> float:
    """Mean normalised innovation squared over the parts; 1 where the model and the noise level are right."""
    runs = [filter_blocks(observations, *part, start, densities) for part in parts]
    return sum(run.nis for run in runs) / max(sum(run.measurements for run in runs), 1)


def noise_posterior(
    observations: BlockObservations, start: StateEstimate, parts: list[TuningPart], densities: Array
) -> NoisePosterior:
    """Posterior of the stiffness rate's density about the most probable one: one node, or three if it is uncertain.

    The nodes of all axes are evaluated together, because each axis has its own score. The derivative of the
    log-posterior by ln q is a parabola through the scores at the three nodes.

    Args:
        densities: the most probable ones, shape (axes, 4).
    """
    nodes = np.array([-NODE_SPACING_LOG, 0.0, NODE_SPACING_LOG])
    by_node = np.repeat(densities[None], nodes.size, axis=0)
    by_node[:, :, STIFFNESS_RATE_COLUMN] *= np.exp(nodes)[:, None]
    squares, information = np.empty((2, *by_node.shape))
    for i in (1, 0, 2):  # the middle one first: if the density is known, the others are not needed
        terms = _score_terms(observations, parts, start, by_node[i])
        squares[i], information[i] = (term[:-1].reshape(by_node[i].shape) for term in terms)
        dof = (information * by_node * observations.signal.step)[:, :, STIFFNESS_RATE_COLUMN]
        if i == 1 and (dof[1] > MIN_KNOWN_DOF).all():
            axes = len(densities)
            return NoisePosterior(densities[None], np.ones((axes, 1)), np.ones((axes, 1, 1)))
    slopes = 0.5 * ((squares * by_node * observations.signal.step)[:, :, STIFFNESS_RATE_COLUMN] - dof) + 0.5
    log_ratio = np.linspace(nodes[0], nodes[-1], POSTERIOR_POINTS)
    weights = np.stack([np.interp(log_ratio, nodes, unit) for unit in np.eye(nodes.size)])
    mean, products = [], []
    for axis_slopes in slopes.T:
        log_posterior = np.polyval(np.polyint(np.polyfit(nodes, axis_slopes, 2)), log_ratio)
        posterior = np.exp(log_posterior - log_posterior.max())
        posterior /= posterior.sum()
        mean.append(weights @ posterior)
        products.append((weights * posterior) @ weights.T)
    return NoisePosterior(by_node, np.array(mean), np.array(products))


def _sum_by_density(sums: Array, axes: int) -> Array:
    """Sums by state as sums by density, shape (4 axes + 1,).

    Of each axis phase and ln A together, stiffness rate, damping and gain; then the offset.
    """
    by_state = sums[: axes * AXIS_STATES].reshape(axes, AXIS_STATES)
    phase_and_log = by_state[:, PHASE] + by_state[:, LOG_AMPLITUDE]
    of_axes = np.stack([phase_and_log, *by_state[:, [STIFFNESS_RATE, DAMPING, GAIN]].T], axis=1)
    return np.append(of_axes, sums[axes * AXIS_STATES])


def tuning_parts(signal: BlockSignal) -> list[TuningPart]:
    """The blocks to tune on: all, or a third of MAX_TUNING_BLOCKS each at the beginning, middle and end."""
    blocks, third = len(signal.whitened), MAX_TUNING_BLOCKS // 3
    starts = (0, (blocks - third) // 2, blocks - third)
    parts = [signal]
    if blocks > MAX_TUNING_BLOCKS:
        parts = [select_blocks(signal, start, start + third) for start in starts]
    return [TuningPart(part, empty_linearisation(part)) for part in parts]
