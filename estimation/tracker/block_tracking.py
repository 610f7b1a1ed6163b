"""Tracks of the state over consecutive blocks: filter and smoother in windows, clipped blocks, noise averaging."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimation.tracker import rts_smoother
from estimation.tracker.clipping import linearise_clipped_blocks
from estimation.tracker.filter_run import filter_blocks, select_blocks
from estimation.tracker.kalman_filter import StateEstimate
from estimation.tracker.linearisation import empty_linearisation
from estimation.tracker.observations import BlockObservations
from estimation.tracker.process_noise import NoisePosterior
from estimation.tracker.state_space import AXIS_STATES, LOG_AMPLITUDE, MIN_AMPLITUDE_THETA0, PHASE
from scanner.arrays import Array

WINDOW_BLOCKS = 4096
"""Blocks that are smoothed at a time: bounds the memory of their covariances to some 50 MB."""

LOOKAHEAD_BLOCKS = 512
"""Blocks after a window from which its last blocks are smoothed: many correlation times of the estimate."""

MAX_EXPANSIONS = 30
"""Most iterations of expanding clipped blocks about the track; 3 to 10 are usual."""

EXPANSION_TOLERANCE_SD = 0.05
"""Change of the track, in its standard deviations, at which the expansion of clipped blocks has converged."""


@dataclass(frozen=True)
class StateTrack:
    """Estimated state along the blocks.

    Attributes:
        states: means, shape (blocks, states), see ``state_space``. sds: standard deviations, same shape.
        log_likelihood: of the projections, up to a constant.
        mean_nis: mean normalised innovation squared; 1 where model and noise are right.
        acquired: whether the motion of each axis was detected, shape (axes,).
        next_prior: estimate before the block after the last one, if there is one; else before the last block.
    """

    states: Array
    sds: Array
    log_likelihood: float
    mean_nis: float
    acquired: NDArray[np.bool_]
    next_prior: StateEstimate


def track_blocks(
    observations: BlockObservations,
    start: StateEstimate,
    densities: Array,
    causal: bool = False,
    stop: int | None = None,
) -> list[StateTrack]:
    """Track of all blocks, or of those before ``stop``, for each of several process noises.

    It proceeds by windows, so that memory does not grow with the number of blocks.

    Args:
        start: estimate before the first block. densities: shape (tracks, axes, 4), see ``process_noise``.
        causal: filtered instead of smoothed states.
    """
    blocks = len(observations.time)
    stop, n = min(stop or blocks, blocks), start.mean.size
    states, sds = np.empty((2, len(densities), stop, n))
    acquired = np.tile(start.acquired, (len(densities), 1))
    totals, priors, first = np.zeros((len(densities), 3)), [start] * len(densities), 0
    while first < stop:
        done = min(first + WINDOW_BLOCKS, stop)
        size = done - first
        part = select_blocks(observations.signal, first, min(done + LOOKAHEAD_BLOCKS, blocks))
        linear = empty_linearisation(part)  # made about the first track; the others are near it
        for i, values in enumerate(densities):
            run = filter_blocks(observations, part, linear, priors[i], values)
            history = run.history
            acquired[i] |= run.acquired
            totals[i] += run.log_likelihood, run.nis, run.measurements
            following = size if done < blocks else size - 1
            x, P = history.predicted_states[following, :n], history.predicted_covariances[following, :n, :n]
            floor = np.log([2.0 * MIN_AMPLITUDE_THETA0 * law.theta0 for law in observations.parameters])
            priors[i] = StateEstimate(x.copy(), P.copy(), x[LOG_AMPLITUDE::AXIS_STATES][: floor.size] > floor)
            if not causal:
                rts_smoother.run_smoother(part.step, history)
            variances = np.diagonal(history.covariances[:size], axis1=1, axis2=2)[:, :n]
            states[i, first:done] = history.states[:size, :n]
            sds[i, first:done] = np.sqrt(np.maximum(variances, 0.0))
        first = done
    return [
        StateTrack(means, deviations, log_likelihood, nis / max(count, 1.0), detected, prior)
        for means, deviations, (log_likelihood, nis, count), detected, prior in zip(
            states, sds, totals.tolist(), acquired, priors, strict=True
        )
    ]


def expand_clipped_blocks(
    observations: BlockObservations, start: StateEstimate, densities: Array, causal: bool
) -> BlockObservations:
    """The observations with clipped samples expanded about the track, iterated until the track converges.

    Args:
        densities: shape (axes, 4).
    """
    previous: Array | None = None
    for _ in range(MAX_EXPANSIONS if observations.clipped.block.size else 0):
        track = track_blocks(observations, start, densities[None], causal)[0]
        if previous is not None and (np.abs(track.states - previous) <= EXPANSION_TOLERANCE_SD * track.sds).all():
            break
        previous = track.states
        observations = linearise_clipped_blocks(observations, previous)
    return observations


def average_over_noise(
    observations: BlockObservations,
    start: StateEstimate,
    posterior: NoisePosterior,
    causal: bool = False,
    stop: int | None = None,
) -> StateTrack:
    """Track averaged over the posterior of the process noise; the variance includes its uncertainty.

    With node tracks x_j and covariances P_j and interpolation weights h_j: mean sum E[h_j] x_j, variance
    sum E[h_j] P_j + sum E[h_j h_k] x_j x_k - mean^2. The most probable process noise alone gives as good a mean, but
    its 95 % intervals would contain the truth in 91 % of the blocks at low signal-to-noise ratio
    (docs/explanation/tracker.md).
    """
    tracks = track_blocks(observations, start, posterior.densities, causal, stop)
    centre = tracks[len(tracks) // 2]
    states, sds = centre.states.copy(), centre.sds.copy()
    for a in range(len(observations.parameters)):
        mine = slice(a * AXIS_STATES, (a + 1) * AXIS_STATES)
        difference = np.stack([track.states[:, mine] - centre.states[:, mine] for track in tracks])
        period = 2.0 * np.pi / observations.signal.main_order
        difference[:, :, PHASE] -= period * np.round(difference[:, :, PHASE] / period)
        shift = np.tensordot(posterior.mean_weights[a], difference, 1)
        variance = np.tensordot(posterior.mean_weights[a], np.stack([track.sds[:, mine] ** 2 for track in tracks]), 1)
        variance += np.einsum("ij,iks,jks->ks", posterior.weight_products[a], difference, difference) - shift**2
        states[:, mine] += shift
        sds[:, mine] = np.sqrt(np.maximum(variance, 0.0))
    return replace(centre, states=states, sds=sds)
