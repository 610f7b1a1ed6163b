"""Kalman filter over blocks, compiled; ``step`` carries the state between them, ``backward`` smooths what it leaves.

A block's projections are the measurement: whitened by its Gram matrix they are independent of each other, so that they
come in one at a time and nothing is inverted. ``linear`` holds what they should be about a state nearby.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from estimation.tracker.linear import linearise, predict
from estimation.tracker.orbit import turn_of
from estimation.tracker.step import (
    DAMPING,
    GAIN,
    LOG,
    NONLINEAR,
    PHASE,
    STATES,
    STIFFNESS,
    TREND,
    TRIES,
    bound,
    change,
    padded,
)

Array = NDArray[np.float64]

LOST = (0.5, 0.3)  # sd of phase [rad] and ln A beyond which the block itself tells where the motion is
SIGNIFICANT = 6.0  # standard deviations that a line must have to be taken for a motion
MISFIT = 4.0  # mean squared innovation beyond which the motion itself must have jumped
BROKEN = 100.0  # beyond which it is looked for anew
ASTRAY = 0.5  # change of state beyond which a linearisation kept from elsewhere is no place to start from
OPEN = (0.02, 3.0)  # sd of the stiffness and its trend [1/s] that a jump may at most give them


class Filtered(NamedTuple):
    """What a filter leaves of each block.

    Attributes:
        states: shape (blocks, n), n made up to a multiple of LANES. covariances: shape (blocks, n, n).
        predicted_states, predicted_covariances: before the block's own measurements, shapes likewise.
        taken: of the step that leads to the block, see ``step.leave``, shape (blocks, axes, 2, 5).
        slopes: of the log-likelihood of the block's measurements by its state there, shape (blocks, n).
        noise: variance of a sample, infinite where the block told nothing, shape (blocks,) [V^2].
    """

    states: Array
    covariances: Array
    predicted_states: Array
    predicted_covariances: Array
    taken: Array
    slopes: Array
    noise: Array


def unfiltered(blocks: int, axes: int) -> Filtered:
    """Room for what a filter leaves."""
    n = padded(STATES * axes + 1)
    by_block = (n,), (n, n), (n,), (n, n), (axes, 2, DAMPING + 1), (n,), ()
    return Filtered(*(np.empty((blocks, *shape)) for shape in by_block))


@njit(cache=True, error_model="numpy")
def _acquire(signal, k, a, x, P):  # type: ignore[no-untyped-def]
    """Set phase and amplitude of axis ``a`` from block k's main line alone; False where it shows none."""
    root, unroot = signal.roots[signal.geometry[k], 0], signal.unroots[signal.geometry[k]]
    fitted = unroot @ signal.whitened[k]
    at = a * STATES
    for i in range(signal.lines.shape[0]):
        if signal.lines[i, 0] == a and signal.lines[i, 1] == signal.main:
            line = complex(fitted[1 + 2 * i], -fitted[2 + 2 * i])
            var = signal.noise_var[k] * max((unroot[1 + 2 * i] ** 2).sum(), (unroot[2 + 2 * i] ** 2).sum())
            missing = (root[:, 1 + 2 * i] ** 2).sum() <= 0.0
            if missing or abs(line) < SIGNIFICANT * np.sqrt(var):
                return False
            size = abs(line / signal.passed[k, i]) / np.exp(x[at + GAIN])
            x[at + LOG] = np.log(np.interp(size, signal.ladder[a, 1], signal.ladder[a, 0]))
            sine = 0.5 * np.pi * (signal.main == 1)  # theta = A sin u is Re(-i A exp(i u)), C's second line is positive
            turn = np.angle(line / signal.passed[k, i] * np.exp(-1j * signal.main * signal.psi[k, a])) + sine
            period = 2.0 * np.pi / signal.main
            phase = turn / signal.main
            x[at + PHASE] = phase + period * np.round((x[at + PHASE] - phase) / period)
            for j in (at + PHASE, at + LOG):
                P[j, :] = 0.0
                P[:, j] = 0.0
            P[at + PHASE, at + PHASE], P[at + LOG, at + LOG] = LOST[0] ** 2, LOST[1] ** 2
            return True
    return False


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _in_turn(rows, rest, count, off, P, noise):  # type: ignore[no-untyped-def]
    """Measurements one at a time, in place on ``off``, a state from where they were linearised, and its covariance.

    Plain arrays and no views: on matrices this small those take as long as the sums.

    Returns:
        (squared normalised innovations, logarithm of their variances' product).
    """
    n, chi2, logdet = off.size, 0.0, 0.0
    PH = np.empty(n)
    for i in range(count):
        e, S = rest[i], noise
        for u in range(n):
            held = 0.0
            for v in range(n):
                held += P[u, v] * rows[i, v]
            PH[u] = held
            S += rows[i, u] * held
            e -= rows[i, u] * off[u]
        scale = 1.0 / S
        for u in range(n):
            gain = PH[u] * scale
            off[u] += gain * e
            for v in range(n):
                P[u, v] -= gain * PH[v]
        chi2 += e * e * scale
        logdet += np.log(S)
    return chi2, logdet


@njit(cache=True, error_model="numpy")
def _update(signal, k, x, P, linear, noise):  # type: ignore[no-untyped-def]
    """Bring block k's measurements, as linearised, into ``x`` and ``P``, in place.

    noise: variance of a sample [V^2].

    Returns:
        (log-likelihood, squared normalised innovations, measurements), the last two of the projections alone.
    """
    about, count, known = linear.about[k], linear.counts[k], 0.0  # a known phase that misfits is no jump of the motion
    for u in range(x.size):
        x[u] -= about[u]
    chi2, logdet = _in_turn(linear.rows[k], linear.rest[k], count, x, P, noise)
    for u in range(x.size):
        x[u] += about[u]
    for a in range(signal.psi.shape[1]):
        if np.isfinite(signal.known_var[k, a]):
            at = a * STATES + PHASE
            PH, S = P[at].copy(), P[at, at] + signal.known_var[k, a]
            e = _beside(signal, k, a, x)
            x += PH / S * e
            P -= np.outer(PH, PH) / S
            known += e * e / S + np.log(S)
    return -0.5 * (chi2 + logdet + known), chi2, count


@njit(cache=True, error_model="numpy")
def _beside(signal, k, a, x):  # type: ignore[no-untyped-def]
    """How far block k's known phase of axis ``a`` lies from the state's [rad]; theta and -theta may look alike."""
    period = 2.0 * np.pi / signal.main
    e = signal.known[k, a] - x[a * STATES + PHASE]
    return e - period * np.round(e / period)


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _slope(signal, k, x, linear, noise, out):  # type: ignore[no-untyped-def]
    """Slope of the log-likelihood of block k's measurements by the state, at ``x``, into ``out`` (states,)."""
    about, information = linear.about[k], linear.information[k]
    for u in range(x.size):
        told = linear.slope[k, u]
        for v in range(x.size):
            told -= information[u, v] * (x[v] - about[v])
        out[u] = told / noise
    for a in range(signal.psi.shape[1]):
        if np.isfinite(signal.known_var[k, a]):
            out[a * STATES + PHASE] += _beside(signal, k, a, x) / signal.known_var[k, a]


@njit(cache=True, error_model="numpy")
def _measured(laws, signal, k, before, P_before, linear, noise):  # type: ignore[no-untyped-def]
    """State and covariance with block k's measurements, linearised anew until they stay; what ``_update`` returns."""
    if not change(before, linear.about[k], signal.step) < ASTRAY:
        linearise(laws, signal, k, before, linear)
    for tried in range(TRIES):
        x, P = before.copy(), P_before.copy()
        here = _update(signal, k, x, P, linear, noise)
        if change(x, linear.about[k], signal.step) < NONLINEAR or tried == TRIES - 1:
            break
        about = x.copy()
        bound(laws, signal, about)
        linearise(laws, signal, k, about, linear)
    return x, P, here


@njit(cache=True, error_model="numpy")
def _reopen(laws, signal, k, x, P, taken, misfit):  # type: ignore[no-untyped-def]
    """Let a jump in: phase, amplitude and stiffness become as uncertain as the misfit says, or are found anew."""
    scale = min(misfit, BROKEN)
    for a in range(len(laws)):
        at = a * STATES
        if misfit > BROKEN and _acquire(signal, k, a, x, P):
            taken[a] = 0.0
        else:
            P[at + PHASE, at + PHASE] *= scale
            P[at + LOG, at + LOG] *= scale
        for i, sd in ((at + STIFFNESS, OPEN[0]), (at + TREND, OPEN[1])):
            P[i, i] = max(P[i, i], min(P[i, i] * scale, sd * sd))


@njit(cache=True, error_model="numpy")
def run_filter(laws, signal, x, P, live, walk, offset_walk, linear, filtered):  # type: ignore[no-untyped-def]
    """Filter all blocks.

    Args:
        laws: an ``AxisLaw`` a row. signal: ``Signal``.
        x, P: state before the first block, made up to a multiple of LANES; changed.
        live: whether the motion of each axis was found, shape (axes,); changed.
        walk: shape (axes, 4), see ``step.arrive``. offset_walk: [V^2/s].
        linear: ``Linear`` of the same blocks; what is made here serves the next run as well.
        filtered: ``Filtered``, to be filled.

    Returns:
        (log-likelihood, sum of squared normalised innovations, measurements).
    """
    total, chi2, count = 0.0, 0.0, 0
    for k in range(signal.whitened.shape[0]):
        taken, found = filtered.taken[k], k == 0 and linear.about[0, 0] == np.inf
        if k > 0:
            predict(laws, signal, k - 1, x, P, walk, offset_walk, linear, taken)
        for a in range(len(laws)):
            at = a * STATES
            lost = P[at + PHASE, at + PHASE] > LOST[0] ** 2 or P[at + LOG, at + LOG] > LOST[1] ** 2
            if (not live[a] or lost) and _acquire(signal, k, a, x, P):
                taken[a] = 0.0
                live[a] = found = True
        if found and change(x, linear.about[k], signal.step) > NONLINEAR:
            linearise(laws, signal, k, x, linear)
        before, P_before, noise, told = x, P, signal.noise_var[k], True
        x, P, here = _measured(laws, signal, k, before, P_before, linear, noise)
        misfit = here[1] / max(here[2], 1)
        if misfit > MISFIT:  # the block is clean, so the model missed a jump: it is let in
            _reopen(laws, signal, k, before, P_before, taken, misfit)
            for _ in range(TRIES):
                x, P, here = _measured(laws, signal, k, before, P_before, linear, noise)
                misfit = here[1] / max(here[2], 1)
                if misfit < MISFIT:
                    break
                noise *= misfit if misfit < BROKEN else BROKEN  # what no state explains counts as noise
            else:
                x, P, told = before, P_before, False
        filtered.predicted_states[k], filtered.predicted_covariances[k] = before, P_before
        total, count = total + here[0], count + here[2]
        chi2 += here[1] * noise / signal.noise_var[k]
        filtered.noise[k] = noise if told else np.inf
        _slope(signal, k, x, linear, filtered.noise[k], filtered.slopes[k])
        bound(laws, signal, x)
        filtered.states[k], filtered.covariances[k] = x, P
    return total, chi2, count


@njit(cache=True, error_model="numpy")
def turns(law, w, force, states, rates, moved):  # type: ignore[no-untyped-def]
    """Rates d(ln A)/dt + i dphi/dt (blocks,) and own harmonics (blocks, MOVED + 1) of one axis along its track."""
    for k in range(states.shape[0]):
        x = states[k]
        stiff, damp = law.k * (1.0 + x[STIFFNESS]), law.b * (1.0 + x[DAMPING])
        turn = turn_of(law, np.exp(x[LOG]), x[PHASE], w[k], stiff, damp, force[k])
        rates[k], moved[k] = turn.rate, turn.moved
