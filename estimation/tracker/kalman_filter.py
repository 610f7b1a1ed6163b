"""Iterated extended Kalman filter over the blocks of a sense channel, compiled.

``state_space`` propagates the state between blocks; ``rts_smoother`` smooths the filter's output. The measurement of a
block is its projections on the harmonics. Whitened by their Gram matrix, their errors are independent, so that they are
processed one at a time and no innovation covariance is inverted. ``linearisation`` holds the expected projections and
their Jacobian about a nearby state.

A block whose mean normalised innovation squared (NIS) exceeds ``JUMP_NIS`` shows that the motion jumped. The predicted
covariance is then increased and the update is repeated.

Source: Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation (Wiley 2001).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from estimation.tracker.averaged_dynamics import average_cycle
from estimation.tracker.linearisation import linearise, predict
from estimation.tracker.state_space import (
    AXIS_STATES,
    DAMPING,
    GAIN,
    LOG_AMPLITUDE,
    MAX_ITERATIONS,
    PHASE,
    RELINEARISE_DISTANCE,
    STIFFNESS,
    STIFFNESS_RATE,
    clip_amplitudes,
    padded_size,
    state_distance,
)
from scanner.arrays import Array

REACQUIRE_SD = (0.5, 0.3)
"""Standard deviations of phase [rad] and ln A above which a block's main line alone replaces the prediction.

Beyond about half a radian the linearised measurement is no longer valid.
"""

DETECTION_SIGMA = 6.0
"""Standard deviations of noise that a line has to exceed to count as a motion: one false alarm in 7e7 blocks."""

JUMP_NIS = 4.0
"""Mean NIS of a block above which the motion has jumped. Noise exceeds it once in 6e4 blocks of ten projections."""

REACQUIRE_NIS = 100.0
"""Mean NIS above which phase and amplitude are acquired from the block, as at the start, instead of corrected."""

MAX_REUSE_DISTANCE = 0.5
"""``state_distance`` beyond which a stored linearisation is no starting point for the iterated update."""

JUMP_SD = (0.02, 3.0, 0.5)
"""Largest standard deviations of stiffness [1], its rate [1/s] and damping [1] that a jump may cause: 2 %, 2 % in 7 ms,
and half of the damping, so that it is positive within two standard deviations.

A phase that the device file misses by 37 degrees, as by filters behind the demodulator, needs another ratio of damping
to drive as well as another resonance: with the damping fixed, the phase would be biased by one to two degrees.
"""


@dataclass(frozen=True)
class StateEstimate:
    """Distribution of the state before a block.

    Attributes:
        mean: shape (states,), see ``state_space``. covariance: shape (states, states).
        acquired: whether the motion of each axis has been detected, shape (axes,).
    """

    mean: Array
    covariance: Array
    acquired: NDArray[np.bool_]


class FilterHistory(NamedTuple):
    """Output of a filter, block by block; n is the number of states, padded to a multiple of SIMD_WIDTH.

    Attributes:
        states: filtered means, shape (blocks, n). covariances: shape (blocks, n, n).
        predicted_states, predicted_covariances: before the block's measurements, same shapes.
        transitions: of the step that leads to the block, shape (blocks, axes, 2, DAMPING + 1), see ``propagate_mean``.
        scores: derivative of the block's log-likelihood by the state, at the filtered mean, shape (blocks, n).
        noise_var: variance of a sample; infinite where the block was not used, shape (blocks,) [V^2].
    """

    states: Array
    covariances: Array
    predicted_states: Array
    predicted_covariances: Array
    transitions: Array
    scores: Array
    noise_var: Array


def empty_history(blocks: int, axes: int) -> FilterHistory:
    """Arrays for the output of a filter."""
    n = padded_size(AXIS_STATES * axes + 1)
    by_block = (n,), (n, n), (n,), (n, n), (axes, 2, DAMPING + 1), (n,), ()
    return FilterHistory(*(np.empty((blocks, *shape)) for shape in by_block))


@njit(cache=True, error_model="numpy")
def _acquire(signal, k, a, x, P):  # type: ignore[no-untyped-def]
    """Set phase and amplitude of axis ``a`` from block k's main line alone; False where the line is not significant."""
    moments, solver = signal.whitened_moments[signal.geometry[k], 0], signal.solvers[signal.geometry[k]]
    fitted = solver @ signal.whitened[k]
    at = a * AXIS_STATES
    for i in range(signal.lines.shape[0]):
        if signal.lines[i, 0] == a and signal.lines[i, 1] == signal.main_order:
            line = complex(fitted[1 + 2 * i], -fitted[2 + 2 * i])
            var = signal.noise_var[k] * max((solver[1 + 2 * i] ** 2).sum(), (solver[2 + 2 * i] ** 2).sum())
            missing = (moments[:, 1 + 2 * i] ** 2).sum() <= 0.0
            if missing or abs(line) < DETECTION_SIGMA * np.sqrt(var):
                return False
            size, table = abs(line / signal.response[k, i]) / np.exp(x[at + GAIN]), signal.amplitude_table
            x[at + LOG_AMPLITUDE] = np.log(np.interp(size, table[a, 1], table[a, 0]))
            sine = 0.5 * np.pi * (signal.main_order == 1)  # A sin u = Re(-i A exp(i u)); C's second line is positive
            turn = np.angle(line / signal.response[k, i] * np.exp(-1j * signal.main_order * signal.psi[k, a])) + sine
            period = 2.0 * np.pi / signal.main_order
            phase = turn / signal.main_order
            x[at + PHASE] = phase + period * np.round((x[at + PHASE] - phase) / period)
            for j in (at + PHASE, at + LOG_AMPLITUDE):
                P[j, :] = 0.0
                P[:, j] = 0.0
            P[at + PHASE, at + PHASE] = REACQUIRE_SD[0] ** 2
            P[at + LOG_AMPLITUDE, at + LOG_AMPLITUDE] = REACQUIRE_SD[1] ** 2
            return True
    return False


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _update_sequentially(rows, residual, count, deviation, P, noise_var):  # type: ignore[no-untyped-def]
    """Update by ``count`` independent measurements, one at a time, in place on ``deviation`` and ``P``.

    Loops over plain arrays: on matrices this small, library calls and views take as long as the sums.

    Args:
        deviation: state minus linearisation point, shape (n,).

    Returns:
        (NIS summed over the measurements, logarithm of the product of their innovation variances).
    """
    n, nis, log_det = deviation.size, 0.0, 0.0
    PH = np.empty(n)
    for i in range(count):
        innovation, S = residual[i], noise_var
        for u in range(n):
            total = 0.0
            for v in range(n):
                total += P[u, v] * rows[i, v]
            PH[u] = total
            S += rows[i, u] * total
            innovation -= rows[i, u] * deviation[u]
        scale = 1.0 / S
        for u in range(n):
            gain = PH[u] * scale
            deviation[u] += gain * innovation
            for v in range(n):
                P[u, v] -= gain * PH[v]
        nis += innovation * innovation * scale
        log_det += np.log(S)
    return nis, log_det


@njit(cache=True, error_model="numpy")
def _update(signal, k, x, P, linear, noise_var):  # type: ignore[no-untyped-def]
    """Update ``x`` and ``P`` in place by block k's linearised measurements. noise_var: of a sample [V^2].

    An external phase does not count in the NIS: if it misfits, that is no sign of a jump.

    Returns:
        (log-likelihood, NIS summed over the projections, number of projections).
    """
    point, count, external = linear.point[k], linear.counts[k], 0.0
    for u in range(x.size):
        x[u] -= point[u]
    nis, log_det = _update_sequentially(linear.jacobian[k], linear.residual[k], count, x, P, noise_var)
    for u in range(x.size):
        x[u] += point[u]
    for a in range(signal.psi.shape[1]):
        if np.isfinite(signal.external_var[k, a]):
            at = a * AXIS_STATES + PHASE
            PH, S = P[at].copy(), P[at, at] + signal.external_var[k, a]
            innovation = _external_innovation(signal, k, a, x)
            x += PH / S * innovation
            P -= np.outer(PH, PH) / S
            external += innovation * innovation / S + np.log(S)
    return -0.5 * (nis + log_det + external), nis, count


@njit(cache=True, error_model="numpy")
def _external_innovation(signal, k, a, x):  # type: ignore[no-untyped-def]
    """External phase of axis ``a`` in block k minus the state's [rad], modulo pi where theta and -theta give the same
    signal."""
    period = 2.0 * np.pi / signal.main_order
    innovation = signal.external_phase[k, a] - x[a * AXIS_STATES + PHASE]
    return innovation - period * np.round(innovation / period)


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _fill_score(signal, k, x, linear, noise_var, out):  # type: ignore[no-untyped-def]
    """Derivative of block k's log-likelihood by the state, at ``x``, into ``out``, shape (states,)."""
    point, information = linear.point[k], linear.information[k]
    for u in range(x.size):
        gradient = linear.gradient[k, u]
        for v in range(x.size):
            gradient -= information[u, v] * (x[v] - point[v])
        out[u] = gradient / noise_var
    for a in range(signal.psi.shape[1]):
        if np.isfinite(signal.external_var[k, a]):
            out[a * AXIS_STATES + PHASE] += _external_innovation(signal, k, a, x) / signal.external_var[k, a]


@njit(cache=True, error_model="numpy")
def _update_iterated(laws, signal, k, predicted, P_predicted, linear, noise_var):  # type: ignore[no-untyped-def]
    """Updated state and covariance, linearised again until they converge, and the result of ``_update``."""
    if not state_distance(predicted, linear.point[k], signal.step) < MAX_REUSE_DISTANCE:
        linearise(laws, signal, k, predicted, linear)
    for iteration in range(MAX_ITERATIONS):
        x, P = predicted.copy(), P_predicted.copy()
        result = _update(signal, k, x, P, linear, noise_var)
        converged = state_distance(x, linear.point[k], signal.step) < RELINEARISE_DISTANCE
        if converged or iteration == MAX_ITERATIONS - 1:
            break
        point = x.copy()
        clip_amplitudes(laws, signal, point)
        linearise(laws, signal, k, point, linear)
    return x, P, result


@njit(cache=True, error_model="numpy")
def _inflate_covariance(laws, signal, k, x, P, transitions, mean_nis):  # type: ignore[no-untyped-def]
    """Admit a jump: scale the variances of all states but the gain by the mean NIS, or acquire the motion again."""
    scale = min(mean_nis, REACQUIRE_NIS)
    for a in range(len(laws)):
        at = a * AXIS_STATES
        if mean_nis > REACQUIRE_NIS and _acquire(signal, k, a, x, P):
            transitions[a] = 0.0
        else:
            P[at + PHASE, at + PHASE] *= scale
            P[at + LOG_AMPLITUDE, at + LOG_AMPLITUDE] *= scale
        for i, sd in ((at + STIFFNESS, JUMP_SD[0]), (at + STIFFNESS_RATE, JUMP_SD[1]), (at + DAMPING, JUMP_SD[2])):
            P[i, i] = max(P[i, i], min(P[i, i] * scale, sd * sd))


@njit(cache=True, error_model="numpy")
def run_filter(laws, signal, x, P, acquired, densities, offset_density, linear, history):  # type: ignore[no-untyped-def]
    """Filter all blocks.

    Args:
        laws: rows of ``AxisParameters``, shape (axes, 11). signal: ``BlockSignal``.
        x, P: mean and covariance before the first block, padded to a multiple of SIMD_WIDTH; changed.
        acquired: whether the motion of each axis was detected, shape (axes,); changed.
        densities: of the process noise, shape (axes, 4), see ``state_space``. offset_density: [V^2/s].
        linear: ``Linearisation`` of the same blocks; the next run reuses what this one adds.
        history: ``FilterHistory``; filled.

    Returns:
        (log-likelihood, NIS summed over all projections, number of projections).
    """
    total, nis, count = 0.0, 0.0, 0
    for k in range(signal.whitened.shape[0]):
        transitions, new = history.transitions[k], k == 0 and linear.point[0, 0] == np.inf
        if k > 0:
            predict(laws, signal, k - 1, x, P, densities, offset_density, linear, transitions)
        for a in range(len(laws)):
            phase, log = a * AXIS_STATES + PHASE, a * AXIS_STATES + LOG_AMPLITUDE
            lost = P[phase, phase] > REACQUIRE_SD[0] ** 2 or P[log, log] > REACQUIRE_SD[1] ** 2
            if (not acquired[a] or lost) and _acquire(signal, k, a, x, P):
                transitions[a] = 0.0
                acquired[a] = new = True
        if new and state_distance(x, linear.point[k], signal.step) > RELINEARISE_DISTANCE:
            linearise(laws, signal, k, x, linear)
        predicted, P_predicted, noise_var, used = x, P, signal.noise_var[k], True
        x, P, result = _update_iterated(laws, signal, k, predicted, P_predicted, linear, noise_var)
        mean_nis = result[1] / max(result[2], 1)
        if mean_nis > JUMP_NIS:
            _inflate_covariance(laws, signal, k, predicted, P_predicted, transitions, mean_nis)
            for _ in range(MAX_ITERATIONS):
                x, P, result = _update_iterated(laws, signal, k, predicted, P_predicted, linear, noise_var)
                mean_nis = result[1] / max(result[2], 1)
                if mean_nis < JUMP_NIS:
                    break
                noise_var *= mean_nis if mean_nis < REACQUIRE_NIS else REACQUIRE_NIS  # no state explains the block
            else:
                x, P, used = predicted, P_predicted, False
        history.predicted_states[k], history.predicted_covariances[k] = predicted, P_predicted
        total, count = total + result[0], count + result[2]
        nis += result[1] * noise_var / signal.noise_var[k]
        history.noise_var[k] = noise_var if used else np.inf
        _fill_score(signal, k, x, linear, history.noise_var[k], history.scores[k])
        clip_amplitudes(laws, signal, x)
        history.states[k], history.covariances[k] = x, P
    return total, nis, count


@njit(cache=True, error_model="numpy")
def fill_track_rates(law, w, force, states, rates, harmonics):  # type: ignore[no-untyped-def]
    """Fill rates r, shape (blocks,), and motion harmonics, (blocks, MAX_MOTION_HARMONIC + 1), of one axis's track."""
    for k in range(states.shape[0]):
        x = states[k]
        stiffness, damping = law.k * (1.0 + x[STIFFNESS]), law.b * (1.0 + x[DAMPING])
        cycle = average_cycle(law, np.exp(x[LOG_AMPLITUDE]), x[PHASE], w[k], stiffness, damping, force[k])
        rates[k], harmonics[k] = cycle.rate, cycle.motion_harmonics
