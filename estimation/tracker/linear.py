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
        for i in range(signal.lines.shape[0]):
            if signal.lines[i, 0] == a:
                order = signal.lines[i, 1]
                grows = 0.0 if turn.seen[order] == 0.0 else (turn.seen_by_log[order] / turn.seen[order]).real
                fades = 1j * grows / order  # a line that decays has a complex frequency
                rate = turn.rate.imag - fades * turn.rate.real
                passed = signal.passed[k, i] + signal.passed_by_w[k, i] * rate
                by_passed = signal.passed_by_w[k, i] / passed if passed != 0.0 else 0.0j
                turned = gain * passed * u**order
                line, by_log = turned * turn.seen[order], turned * turn.seen_by_log[order]
                by_phase = 1j * order * line
                first = by_log * turn.rate.real + by_phase * slip
                second = 0.5 * (by_log * bend.real + by_phase * bend.imag)
                if line != 0.0:
                    second += 0.5 * first * first / line
                for j, part in ((1 + 2 * i, 1.0 + 0.0j), (2 + 2 * i, 1.0j)):  # Re with the cosine, -Im with the sine
                    values[0, j], values[1, j], values[2, j] = (
                        (part * line).real,
                        (part * first).real,
                        (part * second).real,
                    )
                    jacobian[0, j, at + PHASE], jacobian[0, j, at + LOG] = (part * by_phase).real, (part * by_log).real
                    jacobian[0, j, at + GAIN] = values[0, j]
                    for s, by, by_trend in moves:
                        by_bend = turn.by_phase * by.imag + turn.by_log * by.real + by_trend
                        jacobian[0, j, at + s] += (part * line * by_passed * (by.imag - fades * by.real)).real
                        by_first = by_log * by.real + by_phase * by.imag
                        by_second = 0.5 * (by_log * by_bend.real + by_phase * by_bend.imag)
                        if line != 0.0:
                            by_second += by_first * first / line
                        jacobian[1, j, at + s] = (part * by_first).real
                        jacobian[2, j, at + s] = (part * by_second).real
    return values, jacobian


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})
def linearise(laws, signal, k, x, linear):  # type: ignore[no-untyped-def]
    """Linearise block k about the state ``x``, into ``linear``."""
    values, jacobian = expected(laws, signal, k, x, linear.rates[k])
    linear.about[k] = x
    roots, whitened = signal.roots[signal.geometry[k]], signal.whitened[k]
    m, n, count = values.shape[1], x.size, 0
    information, slope = linear.information[k], linear.slope[k]
    information[:], slope[:] = 0.0, 0.0
    for i in range(m):
        size, rest, row = 0.0, whitened[i], linear.rows[k, count]
        row[:] = 0.0
        for j in range(m):
            r0, r1, r2 = roots[0, i, j], roots[1, i, j], roots[2, i, j]
            size += r0 * r0
            rest -= r0 * values[0, j] + r1 * values[1, j] + r2 * values[2, j]
            j0, j1, j2 = jacobian[0, j], jacobian[1, j], jacobian[2, j]
            for u in range(n):
                row[u] += r0 * j0[u] + r1 * j1[u] + r2 * j2[u]
        if size <= 0.0:  # a direction in which the block has no samples
            continue
        linear.rest[k, count] = rest
        for u in range(n):
            slope[u] += row[u] * rest
            for v in range(n):
                information[u, v] += row[u] * row[v]
        count += 1
    linear.counts[k] = count


@njit(cache=True, error_model="numpy")
def predict(laws, signal, k, x, P, walk, offset_walk, linear, taken):  # type: ignore[no-untyped-def]
    """Carry state and covariance of block k to block k + 1, in place; see ``step.leave`` for ``taken``."""
    leave(laws, signal, k, x, P, walk, linear, taken)
    if linear.about[k + 1, 0] == np.inf:  # else it was made about where an earlier run has come to, which is better
        linearise(laws, signal, k + 1, ahead(laws, signal, k, x, linear), linear)
    arrive(laws, signal, k, x, P, walk, offset_walk, linear, taken)
