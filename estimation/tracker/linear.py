"""Blocks linearised, compiled: what a block's projections should be, and how the slow flow goes on from it.

A linearisation serves for as long as the state stays near the one that it was made about: the tuning's rounds and the
tracks that are averaged run over the same blocks again and again, and most of the work of a block does not depend on
the process noise that they try.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from estimation.tracker.orbit import law_of, turn_of
from estimation.tracker.step import (
    DAMPING,
    GAIN,
    LOG,
    PHASE,
    RATES,
    STATES,
    STIFFNESS,
    TREND,
    Signal,
    ahead,
    arrive,
    leave,
    padded,
    set_rates,
)

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


class Linear(NamedTuple):
    """Linearisations of a signal's blocks, filled in as a filter passes.

    Attributes:
        about: state that each was made about, shape (blocks, states); infinite where there is none yet.
        rates: d(ln A)/dt + i dphi/dt of each axis and its derivatives, shape (blocks, axes, RATES) [1/s].
        rows: Jacobian of the whitened projections, shape (blocks, m, states); rest: what they have beyond those
            expected, shape (blocks, m) [V]; counts: how many of the m there are, which come first, shape (blocks,).
        information: rows' rows, shape (blocks, states, states); slope: rows' rest, shape (blocks, states).
    """

    about: Array
    rates: Complex
    rows: Array
    rest: Array
    counts: NDArray[np.int64]
    information: Array
    slope: Array


def unmade(signal: Signal) -> Linear:
    """Room for the linearisations of a signal's blocks; none is made yet."""
    (blocks, m), axes = signal.whitened.shape, signal.psi.shape[1]
    n = padded(STATES * axes + 1)
    return Linear(
        about=np.full((blocks, n), np.inf),
        rates=np.empty((blocks, axes, RATES), np.complex128),
        rows=np.empty((blocks, m, n)),
        rest=np.empty((blocks, m)),
        counts=np.empty(blocks, np.int64),
        information=np.empty((blocks, n, n)),
        slope=np.empty((blocks, n)),
    )


@njit(cache=True, error_model="numpy")
def expected(laws, signal, k, x, rates):  # type: ignore[no-untyped-def]
    """Coefficients that block k's projections should show in the state ``x``, and their Jacobian (3, m, states).

    A line changes over the block as exp(rate t): the coefficients (3, m) are its value and its first two derivatives,
    the last one halved. In a free decay the second is worth half a degree. The rate follows stiffness and damping, so
    that a block off its middle tells of them: left out of the Jacobian, an error of 0.1 % in k looks like a jump.

    Args:
        rates: filled with the slow rates there, shape (axes, RATES), see ``Linear``.
    """
    m = signal.roots.shape[2]
    values, jacobian = np.zeros((3, m)), np.zeros((3, m, x.size))
    offset = STATES * len(laws)
    values[0, 0], jacobian[0, 0, offset] = x[offset], 1.0
    for a in range(len(laws)):
        law = law_of(laws[a])
        at = a * STATES
        stiff, damp = law.k * (1.0 + x[at + STIFFNESS]), law.b * (1.0 + x[at + DAMPING])
        turn = turn_of(law, np.exp(x[at + LOG]), x[at + PHASE], signal.w[k, a], stiff, damp, signal.force[k, a])
        set_rates(law, turn, stiff, damp, rates[a])
        by_stiff, by_damp = rates[a, 3], rates[a, 4]
        # how the rate itself changes along the flow: a motion that follows a drift hardly bends
        bend = turn.by_phase * turn.rate.imag + turn.by_log * turn.rate.real + by_stiff * x[at + TREND]
        values[0, 0] += signal.mean_gain * turn.seen[0].real
        values[0, 0] += signal.mean_delay * turn.seen_by_log[0].real * turn.rate.real
        by_mean = signal.mean_gain * turn.seen_by_log[0].real
        values[1, 0] += by_mean * turn.rate.real
        mean_bend = 0.5 * signal.mean_gain * turn.mean_bend
        values[2, 0] += mean_bend * turn.rate.real**2 + 0.5 * by_mean * bend.real
        jacobian[0, 0, at + LOG] = by_mean
        moves = (
            (PHASE, turn.by_phase, 0.0j),
            (LOG, turn.by_log, 0.0j),
            (STIFFNESS, by_stiff, 0.0j),
            (TREND, 0.0j, by_stiff),
            (DAMPING, by_damp, 0.0j),
        )
        for s, by, by_trend in moves:
            by_bend = turn.by_phase * by.imag + turn.by_log * by.real + by_trend
            jacobian[0, 0, at + s] += signal.mean_delay * turn.seen_by_log[0].real * by.real
            jacobian[1, 0, at + s] = by_mean * by.real
            jacobian[2, 0, at + s] = 2.0 * mean_bend * turn.rate.real * by.real + 0.5 * by_mean * by_bend.real
        slip = signal.w[k, a] + turn.rate.imag - signal.tuned[k, a]
        gain, u = np.exp(x[at + GAIN]), np.exp(1j * (signal.psi[k, a] + x[at + PHASE]))
        power, reached = 1.0 + 0.0j, 0
        for i in range(signal.lines.shape[0]):
            if signal.lines[i, 0] != a:
                continue
            order, cosine, sine = signal.lines[i, 1], 1 + 2 * i, 2 + 2 * i
            while reached < order:
                power *= u
                reached += 1
            grows = 0.0 if turn.seen[order] == 0.0 else (turn.seen_by_log[order] / turn.seen[order]).real
            fades = 1j * grows / order  # a line that decays has a complex frequency
            rate = turn.rate.imag - fades * turn.rate.real
            passed = signal.passed[k, i] + signal.passed_by_w[k, i] * rate
            by_passed = signal.passed_by_w[k, i] / passed if passed != 0.0 else 0.0j
            turned = gain * passed * power
            line, by_log = turned * turn.seen[order], turned * turn.seen_by_log[order]
            by_phase = 1j * order * line
            first = by_log * turn.rate.real + by_phase * slip
            changes = first / line if line != 0.0 else 0.0j
            second = 0.5 * (by_log * bend.real + by_phase * bend.imag + first * changes)
            for n, value in enumerate((line, first, second)):  # Re with the cosine, -Im with the sine
                values[n, cosine], values[n, sine] = value.real, -value.imag
            jacobian[0, cosine, at + PHASE], jacobian[0, sine, at + PHASE] = by_phase.real, -by_phase.imag
            jacobian[0, cosine, at + LOG], jacobian[0, sine, at + LOG] = by_log.real, -by_log.imag
            jacobian[0, cosine, at + GAIN], jacobian[0, sine, at + GAIN] = line.real, -line.imag
            for s, by, by_trend in moves:
                by_bend = turn.by_phase * by.imag + turn.by_log * by.real + by_trend
                by_value = line * by_passed * (by.imag - fades * by.real)
                by_first = by_log * by.real + by_phase * by.imag
                by_second = 0.5 * (by_log * by_bend.real + by_phase * by_bend.imag) + by_first * changes
                jacobian[0, cosine, at + s] += by_value.real
                jacobian[0, sine, at + s] -= by_value.imag
                jacobian[1, cosine, at + s], jacobian[1, sine, at + s] = by_first.real, -by_first.imag
                jacobian[2, cosine, at + s], jacobian[2, sine, at + s] = by_second.real, -by_second.imag
    return values, jacobian


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _gathered(roots, whitened, values, jacobian, lines, rows, rest):  # type: ignore[no-untyped-def]
    """Whitened Jacobian and what the projections have beyond ``values``, into ``rows`` and ``rest``; how many rows.

    A line tells of its own axis alone, so that a row is gathered axis by axis from that axis's columns; the mean, the
    first column, comes from all of them.
    """
    m, n, count = whitened.size, rows.shape[1], 0
    for i in range(m):
        size, left = 0.0, whitened[i]
        for j in range(m):
            size += roots[0, i, j] * roots[0, i, j]
            left -= roots[0, i, j] * values[0, j] + roots[1, i, j] * values[1, j] + roots[2, i, j] * values[2, j]
        if size <= 0.0:  # a direction in which the block has no samples
            continue
        r0, r1, r2 = roots[0, i, 0], roots[1, i, 0], roots[2, i, 0]
        for u in range(n):
            rows[count, u] = r0 * jacobian[0, 0, u] + r1 * jacobian[1, 0, u] + r2 * jacobian[2, 0, u]
        for j in range(1, m):
            r0, r1, r2, at = roots[0, i, j], roots[1, i, j], roots[2, i, j], STATES * lines[(j - 1) // 2, 0]
            for u in range(at, at + STATES):
                rows[count, u] += r0 * jacobian[0, j, u] + r1 * jacobian[1, j, u] + r2 * jacobian[2, j, u]
        rest[count] = left
        count += 1
    return count


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _summed(rows, rest, count, information, slope):  # type: ignore[no-untyped-def]
    """rows' rows and rows' rest into ``information`` and ``slope``."""
    n = slope.size
    for u in range(n):
        slope[u] = 0.0
        for v in range(n):
            information[u, v] = 0.0
    for i in range(count):
        for u in range(n):
            own = rows[i, u]
            slope[u] += own * rest[i]
            for v in range(n):
                information[u, v] += own * rows[i, v]


@njit(cache=True, error_model="numpy")
def linearise(laws, signal, k, x, linear):  # type: ignore[no-untyped-def]
    """Linearise block k about the state ``x``, into ``linear``."""
    values, jacobian = expected(laws, signal, k, x, linear.rates[k])
    rows, rest, roots = linear.rows[k], linear.rest[k], signal.roots[signal.geometry[k]]
    count = _gathered(roots, signal.whitened[k], values, jacobian, signal.lines, rows, rest)
    _summed(rows, rest, count, linear.information[k], linear.slope[k])
    linear.about[k], linear.counts[k] = x, count


@njit(cache=True, error_model="numpy")
def predict(laws, signal, k, x, P, walk, offset_walk, linear, taken):  # type: ignore[no-untyped-def]
    """Carry state and covariance of block k to block k + 1, in place; see ``step.leave`` for ``taken``."""
    leave(laws, signal, k, x, P, walk, linear, taken)
    if linear.about[k + 1, 0] == np.inf:  # else it was made about where an earlier run has come to, which is better
        linearise(laws, signal, k + 1, ahead(laws, signal, k, x, linear), linear)
    arrive(laws, signal, k, x, P, walk, offset_walk, linear, taken)
