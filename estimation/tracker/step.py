"""One step of the tracker's state, compiled: from a block to the next by the slow flow.

State of each axis: phase phi, ln A, relative change of stiffness, its trend [1/s], relative change of damping, ln gain;
then the readout's offset, one for all axes of an electrode. Between two blocks phase and amplitude follow the slow flow
(``orbit``), linearised about the state and integrated exactly, with each block's own drive; the trend of the stiffness,
the damping and the gain walk at random.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from estimation.tracker.orbit import MOVED, law_of, turn_of

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

PHASE, LOG, STIFFNESS, TREND, DAMPING, GAIN = range(6)
STATES = 6  # of an axis

FLOOR = 1e-3  # of theta0: a smaller amplitude is no motion
UNKNOWN = (10.0, 3.0)  # the same at which nothing is known: without data an unstable flow would let them run away
TRIES = 5


class Signal(NamedTuple):
    """One sense channel, block by block.

    Attributes:
        psi: reference phase at the block's middle, shape (blocks, axes) [rad].
        w: its rate there, shape (blocks, axes) [rad/s].
        force: harmonics of the drive's force, shape (blocks, axes, DRIVEN).
        share: part of the step to the next block over which a block's force lasts, shape (blocks, axes).
        step: time from one block to the next [s].
        lines: (axis, order) of each line, shape (lines, 2).
        passed: readout's response at each line, shape (blocks, lines); passed_by_w: its derivative by the motion's
            angular frequency.
        mean_gain: of the readout at rest, 0 where it does not pass a mean; mean_delay: what it adds of a mean's rate.
        tuned: angular frequency of the projections' tables, shape (blocks, axes).
        whitened: R's with R R' the inverse of the Gram matrix, shape (blocks, m).
        roots: R' times the moments of each geometry, shape (geometries, 3, m, m). unroots: R. geometry: of each block.
        noise_var: of a block's samples, shape (blocks,) [V^2].
        known: phase measured otherwise, shape (blocks, axes) [rad]; known_var: its variance, inf for none [rad^2].
        ladder: amplitudes [rad] and the size of the main line of C or theta there, shape (axes, 2, rungs).
        main: order of the main line: 2 for a capacitance, 1 for a position.
    """

    psi: Array
    w: Array
    force: Complex
    share: Array
    step: float
    lines: NDArray[np.int64]
    passed: Complex
    passed_by_w: Complex
    mean_gain: float
    mean_delay: float
    tuned: Array
    whitened: Array
    roots: Array
    unroots: Array
    geometry: NDArray[np.int64]
    noise_var: Array
    known: Array
    known_var: Array
    ladder: Array
    main: int


@njit(cache=True, error_model="numpy")
def flow(law, x, w, force, h, walk):  # type: ignore[no-untyped-def]
    """One axis over ``h`` seconds: new state (6,), what phase and ln A take from the first five states (2, 5), and the
    covariance (6, 6) that walking adds.

    walk: spectral densities of white noise on phase and ln A [1/s], trend [1/s^3], damping [1/s], gain [1/s].
    """
    k, b = law.k * (1.0 + x[STIFFNESS]), law.b * (1.0 + x[DAMPING])
    turn = turn_of(law, np.exp(x[LOG]), x[PHASE], w, k, b, force)
    a11, a12 = turn.by_phase.imag, turn.by_log.imag
    a21, a22 = turn.by_phase.real, turn.by_log.real
    # e0, e1, e2: exp(a h) and its first two integrals, by their series; the h here is a fraction of the decay time
    e = np.zeros((3, 2, 2))
    p11, p12, p21, p22 = 1.0, 0.0, 0.0, 1.0
    for n in range(9):
        one, two = h / (n + 1), h * h / ((n + 1) * (n + 2))
        for i, scale in ((0, 1.0), (1, one), (2, two)):
            e[i, 0, 0] += p11 * scale
            e[i, 0, 1] += p12 * scale
            e[i, 1, 0] += p21 * scale
            e[i, 1, 1] += p22 * scale
        p11, p12, p21, p22 = (
            (a11 * p11 + a12 * p21) * one,
            (a11 * p12 + a12 * p22) * one,
            (a21 * p11 + a22 * p21) * one,
            (a21 * p12 + a22 * p22) * one,
        )
    stiff, damp = law.k * turn.by_stiffness / k, law.b * turn.by_damping / b
    new, taken, added = x.copy(), np.empty((2, DAMPING + 1)), np.zeros((STATES, STATES))
    early = np.zeros(STATES)  # what a kick of the trend in the middle of the step becomes
    for i in range(2):
        by_trend = e[2, i, 0] * stiff.imag + e[2, i, 1] * stiff.real
        new[i] += e[1, i, 0] * turn.rate.imag + e[1, i, 1] * turn.rate.real + by_trend * x[TREND]
        taken[i, PHASE], taken[i, LOG] = e[0, i, 0], e[0, i, 1]
        taken[i, STIFFNESS] = e[1, i, 0] * stiff.imag + e[1, i, 1] * stiff.real
        taken[i, TREND] = by_trend
        taken[i, DAMPING] = e[1, i, 0] * damp.imag + e[1, i, 1] * damp.real
        early[i] = 0.25 * by_trend
        added[i, i] = walk[0] * h
    new[STIFFNESS] += h * x[TREND]
    early[STIFFNESS], early[TREND] = 0.5 * h, 1.0
    for i in range(STATES):
        for j in range(STATES):
            added[i, j] += walk[1] * h * early[i] * early[j]
    added[DAMPING, DAMPING] += walk[2] * h
    added[GAIN, GAIN] += walk[3] * h
    for i in range(2):
        half = 0.5 * taken[i, DAMPING]
        added[i, DAMPING] += walk[2] * h * half
        added[DAMPING, i] += walk[2] * h * half
        added[i, i] += walk[2] * h * half * half
    return new, taken, added


@njit(cache=True, error_model="numpy")
def _switched(law, x, signal, k, a):  # type: ignore[no-untyped-def]
    """Phase and ln A after the drive switched between blocks k and k + 1, from the state before.

    Angle and speed go on; the motion's own harmonics, which the drive makes, and the slow rates do not, and the first
    harmonic takes the difference: a third of a degree when the imaging scanner's drive stops.

    Args:
        x: the axis's state, its phase against the reference of block k + 1.
    """
    stiff, damp = law.k * (1.0 + x[STIFFNESS]), law.b * (1.0 + x[DAMPING])
    psi = signal.psi[k + 1, a] - (1.0 - signal.share[k, a]) * signal.step * signal.w[k + 1, a]
    behind = signal.psi[k, a] + signal.share[k, a] * signal.step * signal.w[k, a] - psi
    phase, log, theta, speed = x[PHASE], x[LOG], 0.0, 0.0
    for i in range(1 + TRIES):
        j = k + min(i, 1)
        own = phase - (0.0 if i else behind)
        turn = turn_of(law, np.exp(log), own, signal.w[j, a], stiff, damp, signal.force[j, a])
        w, u = signal.w[j, a] + turn.rate.imag, psi + phase
        rest, rest_speed = 0.0, np.exp(log) * turn.rate.real * np.sin(u)
        for n in range(MOVED + 1):
            line = turn.moved[n] * np.exp(1j * n * u)
            rest += line.real
            rest_speed -= n * w * line.imag
        if i == 0:
            theta, speed = np.exp(log) * np.sin(u) + rest, np.exp(log) * w * np.cos(u) + rest_speed
        else:
            side, front = theta - rest, (speed - rest_speed) / w
            phase += np.arctan2(side * np.cos(u) - front * np.sin(u), front * np.cos(u) + side * np.sin(u))
            log = 0.5 * np.log(side * side + front * front)
    return phase, log


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _carried(matrix, at, taken, h):  # type: ignore[no-untyped-def]
    """Multiply ``matrix`` in place from the left by the Jacobian of one axis's step, whose states begin at ``at``."""
    for v in range(matrix.shape[1]):
        phase, log = 0.0, 0.0
        for j in range(DAMPING + 1):
            phase += taken[0, j] * matrix[at + j, v]
            log += taken[1, j] * matrix[at + j, v]
        matrix[at + PHASE, v], matrix[at + LOG, v] = phase, log
        matrix[at + STIFFNESS, v] += h * matrix[at + TREND, v]


@njit(cache=True, error_model="numpy")
def predict(laws, signal, k, x, P, walk, offset_walk):  # type: ignore[no-untyped-def]
    """State and covariance of block k + 1 from those of block k, and the Jacobian of the step; ``x`` is changed."""
    n = x.size
    P, F = P.copy(), np.eye(n)
    for later in range(2):
        for a in range(len(laws)):
            law = law_of(laws[a])
            at = a * STATES
            parts = signal.step * signal.share[k, a], signal.step * (1.0 - signal.share[k, a])
            if later:  # against this block's reference, continued straight to where its drive begins
                psi = signal.psi[k, a] + parts[0] * signal.w[k, a]
                x[at + PHASE] += psi - (signal.psi[k + 1, a] - parts[1] * signal.w[k + 1, a])
                if signal.share[k, a] != 0.5:
                    x[at + PHASE], x[at + LOG] = _switched(law, x[at : at + STATES], signal, k, a)
            w, h = signal.w[k + later, a], parts[later]
            new, taken, added = flow(law, x[at : at + STATES], w, signal.force[k + later, a], h, walk[a])
            x[at : at + STATES] = new
            _carried(F, at, taken, h)
            _carried(P, at, taken, h)
            _carried(P.T, at, taken, h)
            P[at : at + STATES, at : at + STATES] += added
        x[:] = bounded(laws, signal, x)
    P[n - 1, n - 1] += offset_walk * signal.step
    for a in range(len(laws)):
        for i, most in ((a * STATES + PHASE, UNKNOWN[0]), (a * STATES + LOG, UNKNOWN[1])):
            if P[i, i] > most * most:
                scale = most / np.sqrt(P[i, i])
                P[i, :] *= scale
                P[:, i] *= scale
    return P, F


@njit(cache=True, error_model="numpy")
def bounded(laws, signal, x):  # type: ignore[no-untyped-def]
    """The state with each amplitude between no motion and the largest that a line can tell."""
    out = x.copy()
    for a in range(len(laws)):
        floor, top = np.log(FLOOR * law_of(laws[a]).theta0), np.log(signal.ladder[a, 0, -1])
        out[a * STATES + LOG] = min(max(x[a * STATES + LOG], floor), top)
    return out
