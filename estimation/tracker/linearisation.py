"""Linearised measurements of the blocks, compiled: expected projections, their Jacobian, and the rates of the state.

A linearisation is kept and reused as long as the state is within ``RELINEARISE_DISTANCE`` of the point that it was made
about. The tuning of the process noise and the tracks that are averaged run over the same blocks a dozen times, and most
of a block's work does not depend on the process noise.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from estimation.tracker.averaged_dynamics import average_cycle, unpack_parameters
from estimation.tracker.block_signal import BlockSignal
from estimation.tracker.state_space import (
    AXIS_STATES,
    DAMPING,
    GAIN,
    LOG_AMPLITUDE,
    PHASE,
    RATE_TERMS,
    STIFFNESS,
    STIFFNESS_RATE,
    extrapolate_state,
    fill_rates,
    padded_size,
    predict_to_block,
    predict_to_boundary,
)
from scanner.arrays import Array, Complex


class Linearisation(NamedTuple):
    """Linearisations of a signal's blocks, filled in as a filter reaches them.

    Attributes:
        point: state that each was made about, shape (blocks, states); infinite where there is none yet.
        rates: d(ln A)/dt + i dphi/dt of each axis and its derivatives, shape (blocks, axes, RATE_TERMS) [1/s].
        jacobian: H of the whitened projections, shape (blocks, m, states).
        residual: e, measured minus expected whitened projections at ``point``, shape (blocks, m) [V].
        counts: number of valid rows of the two, which come first, shape (blocks,).
        information: H'H, shape (blocks, states, states). gradient: H'e, shape (blocks, states).
    """

    point: Array
    rates: Complex
    jacobian: Array
    residual: Array
    counts: NDArray[np.int64]
    information: Array
    gradient: Array


def empty_linearisation(signal: BlockSignal) -> Linearisation:
    """Arrays for the linearisations of a signal's blocks, none of which is made yet."""
    (blocks, m), axes = signal.whitened.shape, signal.psi.shape[1]
    n = padded_size(AXIS_STATES * axes + 1)
    return Linearisation(
        point=np.full((blocks, n), np.inf),
        rates=np.empty((blocks, axes, RATE_TERMS), np.complex128),
        jacobian=np.empty((blocks, m, n)),
        residual=np.empty((blocks, m)),
        counts=np.empty(blocks, np.int64),
        information=np.empty((blocks, n, n)),
        gradient=np.empty((blocks, n)),
    )


@njit(cache=True, error_model="numpy")
def expected_projections(laws, signal, k, x, rates):  # type: ignore[no-untyped-def]
    """Expected line coefficients of block k in the state ``x``, shape (3, m), and their Jacobian, shape (3, m, states).

    Within the block, at time t from its middle, a line is c0 + c1 t + c2 t^2; the three rows are c0, c1 and c2. They
    follow from a line that changes as exp(rate t). In a free decay c2 contributes half a degree of phase. The rate
    depends on stiffness and damping, which is part of the Jacobian: without it, an error of 0.1 % in k would look like
    a phase jump.

    Args:
        laws: rows of ``AxisParameters``, shape (axes, 11). signal: ``BlockSignal``.
        rates: filled with the rates in the state x, shape (axes, RATE_TERMS), see ``fill_rates``.
    """
    m = signal.whitened_moments.shape[2]
    values, jacobian = np.zeros((3, m)), np.zeros((3, m, x.size))
    offset = AXIS_STATES * len(laws)
    values[0, 0], jacobian[0, 0, offset] = x[offset], 1.0
    for a in range(len(laws)):
        law = unpack_parameters(laws[a])
        at = a * AXIS_STATES
        stiffness, damping = law.k * (1.0 + x[at + STIFFNESS]), law.b * (1.0 + x[at + DAMPING])
        amplitude, w, force = np.exp(x[at + LOG_AMPLITUDE]), signal.w[k, a], signal.force[k, a]
        cycle = average_cycle(law, amplitude, x[at + PHASE], w, stiffness, damping, force)
        fill_rates(law, cycle, stiffness, damping, rates[a])
        by_stiffness, by_damping = rates[a, 3], rates[a, 4]
        # second derivative of (ln A, phi) along the flow; small where the motion follows a slow drift
        bend = cycle.by_phase * cycle.rate.imag + cycle.by_log * cycle.rate.real + by_stiffness * x[at + STIFFNESS_RATE]
        values[0, 0] += signal.mean_gain * cycle.readout_harmonics[0].real
        values[0, 0] += signal.mean_delay * cycle.readout_by_log[0].real * cycle.rate.real
        by_mean = signal.mean_gain * cycle.readout_by_log[0].real
        values[1, 0] += by_mean * cycle.rate.real
        mean_bend = 0.5 * signal.mean_gain * cycle.mean_curvature
        values[2, 0] += mean_bend * cycle.rate.real**2 + 0.5 * by_mean * bend.real
        jacobian[0, 0, at + LOG_AMPLITUDE] = by_mean
        derivatives = (  # state, derivative of the rate by it, direct derivative of bend by it
            (PHASE, cycle.by_phase, 0.0j),
            (LOG_AMPLITUDE, cycle.by_log, 0.0j),
            (STIFFNESS, by_stiffness, 0.0j),
            (STIFFNESS_RATE, 0.0j, by_stiffness),
            (DAMPING, by_damping, 0.0j),
        )
        for s, by, direct in derivatives:
            by_bend = cycle.by_phase * by.imag + cycle.by_log * by.real + direct
            jacobian[0, 0, at + s] += signal.mean_delay * cycle.readout_by_log[0].real * by.real
            jacobian[1, 0, at + s] = by_mean * by.real
            jacobian[2, 0, at + s] = 2.0 * mean_bend * cycle.rate.real * by.real + 0.5 * by_mean * by_bend.real
        slip = signal.w[k, a] + cycle.rate.imag - signal.table_w[k, a]
        gain, u = np.exp(x[at + GAIN]), np.exp(1j * (signal.psi[k, a] + x[at + PHASE]))
        power, power_order = 1.0 + 0.0j, 0
        for i in range(signal.lines.shape[0]):
            if signal.lines[i, 0] != a:
                continue
            order, cosine, sine = signal.lines[i, 1], 1 + 2 * i, 2 + 2 * i
            while power_order < order:
                power *= u
                power_order += 1
            harmonic, harmonic_by_log = cycle.readout_harmonics[order], cycle.readout_by_log[order]
            growth = 0.0 if harmonic == 0.0 else (harmonic_by_log / harmonic).real
            decay = 1j * growth / order  # a line that decays has a complex frequency
            rate = cycle.rate.imag - decay * cycle.rate.real
            response = signal.response[k, i] + signal.response_slope[k, i] * rate
            by_response = signal.response_slope[k, i] / response if response != 0.0 else 0.0j
            turned = gain * response * power
            line, by_log = turned * harmonic, turned * harmonic_by_log
            by_phase = 1j * order * line
            first = by_log * cycle.rate.real + by_phase * slip
            changes = first / line if line != 0.0 else 0.0j
            second = 0.5 * (by_log * bend.real + by_phase * bend.imag + first * changes)
            for n, value in enumerate((line, first, second)):  # the cosine's coefficient is Re, the sine's is -Im
                values[n, cosine], values[n, sine] = value.real, -value.imag
            jacobian[0, cosine, at + PHASE], jacobian[0, sine, at + PHASE] = by_phase.real, -by_phase.imag
            jacobian[0, cosine, at + LOG_AMPLITUDE], jacobian[0, sine, at + LOG_AMPLITUDE] = by_log.real, -by_log.imag
            jacobian[0, cosine, at + GAIN], jacobian[0, sine, at + GAIN] = line.real, -line.imag
            for s, by, direct in derivatives:
                by_bend = cycle.by_phase * by.imag + cycle.by_log * by.real + direct
                by_value = line * by_response * (by.imag - decay * by.real)
                by_first = by_log * by.real + by_phase * by.imag
                by_second = 0.5 * (by_log * by_bend.real + by_phase * by_bend.imag) + by_first * changes
                jacobian[0, cosine, at + s] += by_value.real
                jacobian[0, sine, at + s] -= by_value.imag
                jacobian[1, cosine, at + s], jacobian[1, sine, at + s] = by_first.real, -by_first.imag
                jacobian[2, cosine, at + s], jacobian[2, sine, at + s] = by_second.real, -by_second.imag
    return values, jacobian


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _whiten_jacobian(moments, whitened, values, jacobian, lines, rows, residual):  # type: ignore[no-untyped-def]
    """Whiten Jacobian and residual of one block into ``rows`` and ``residual``; returns the number of valid rows.

    A line depends on the states of one axis only, so that a row is summed axis by axis over the columns of that axis.
    The mean, the first column, depends on all states.
    """
    m, n, count = whitened.size, rows.shape[1], 0
    for i in range(m):
        size, rest = 0.0, whitened[i]
        for j in range(m):
            size += moments[0, i, j] * moments[0, i, j]
            rest -= moments[0, i, j] * values[0, j] + moments[1, i, j] * values[1, j] + moments[2, i, j] * values[2, j]
        if size <= 0.0:  # a direction in which the block has no samples
            continue
        r0, r1, r2 = moments[0, i, 0], moments[1, i, 0], moments[2, i, 0]
        for u in range(n):
            rows[count, u] = r0 * jacobian[0, 0, u] + r1 * jacobian[1, 0, u] + r2 * jacobian[2, 0, u]
        for j in range(1, m):
            r0, r1, r2 = moments[0, i, j], moments[1, i, j], moments[2, i, j]
            at = AXIS_STATES * lines[(j - 1) // 2, 0]
            for u in range(at, at + AXIS_STATES):
                rows[count, u] += r0 * jacobian[0, j, u] + r1 * jacobian[1, j, u] + r2 * jacobian[2, j, u]
        residual[count] = rest
        count += 1
    return count


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _sum_information(rows, residual, count, information, gradient):  # type: ignore[no-untyped-def]
    """H'H and H'e of the first ``count`` rows into ``information`` and ``gradient``."""
    n = gradient.size
    for u in range(n):
        gradient[u] = 0.0
        for v in range(n):
            information[u, v] = 0.0
    for i in range(count):
        for u in range(n):
            h = rows[i, u]
            gradient[u] += h * residual[i]
            for v in range(n):
                information[u, v] += h * rows[i, v]


@njit(cache=True, error_model="numpy")
def linearise(laws, signal, k, x, linear):  # type: ignore[no-untyped-def]
    """Linearise block k about the state ``x``, into ``linear``."""
    values, jacobian = expected_projections(laws, signal, k, x, linear.rates[k])
    rows, residual, moments = linear.jacobian[k], linear.residual[k], signal.whitened_moments[signal.geometry[k]]
    count = _whiten_jacobian(moments, signal.whitened[k], values, jacobian, signal.lines, rows, residual)
    _sum_information(rows, residual, count, linear.information[k], linear.gradient[k])
    linear.point[k], linear.counts[k] = x, count


@njit(cache=True, error_model="numpy")
def predict(laws, signal, k, x, P, densities, offset_density, linear, transitions):  # type: ignore[no-untyped-def]
    """Predict state and covariance of block k + 1 from those of block k, in place.

    Arguments as in ``state_space.predict_to_boundary`` and ``predict_to_block``.
    """
    predict_to_boundary(laws, signal, k, x, P, densities, linear, transitions)
    if linear.point[k + 1, 0] == np.inf:  # otherwise an earlier run has linearised about its estimate, a better point
        linearise(laws, signal, k + 1, extrapolate_state(laws, signal, k, x, linear), linear)
    predict_to_block(laws, signal, k, x, P, densities, offset_density, linear, transitions)
