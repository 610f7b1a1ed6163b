"""One step of the tracker's state, compiled: from a block to the next by the slow flow.

State of each axis: phase phi, ln A, relative change of stiffness, its trend [1/s], relative change of damping, ln gain;
then the readout's offset, one for all axes of an electrode, and zeros up to a multiple of LANES. Between two blocks
phase and amplitude follow the slow flow (``orbit``), linearised near the state and integrated exactly, with each
block's own drive; the trend of the stiffness, the damping and the gain walk at random.
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
LANES = 8  # states are made up to a multiple of these: rows of matrices then fill registers, in half the time

FLOOR = 1e-3  # of theta0: a smaller amplitude is no motion
UNKNOWN = (10.0, 3.0)  # the same at which nothing is known: without data an unstable flow would let them run away
TRIES = 5
RATES = 5  # of an axis, see set_rates
NONLINEAR = 2e-3  # step of phase [rad], ln A or anything else, see change, after which a block is linearised anew
STRAIGHT = 1e-5  # rad: what slow rates straight in the state may be off by over a step, see _parts
MOST_PARTS = 16


def padded(states: int) -> int:
    """The next multiple of LANES."""
    return -(-states // LANES) * LANES


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

    def with_blocks(self, block: NDArray[np.int64], whitened: Array, roots: Array, unroots: Array) -> Signal:
        """The signal with other projections of some blocks, each with a geometry of its own."""
        kept = 1 + np.delete(self.geometry, block).max(initial=-1)
        geometry, white = self.geometry.copy(), self.whitened.copy()
        geometry[block], white[block] = kept + np.arange(block.size), whitened
        return self._replace(
            geometry=geometry,
            whitened=white,
            roots=np.concatenate([self.roots[:kept], roots]),
            unroots=np.concatenate([self.unroots[:kept], unroots]),
        )


@njit(cache=True, error_model="numpy")
def set_rates(law, turn, stiff, damp, rates):  # type: ignore[no-untyped-def]
    """The slow rate of a turn and its derivatives by phase, ln A and the states of stiffness and damping, (RATES,)."""
    rates[0], rates[1], rates[2] = turn.rate, turn.by_phase, turn.by_log
    rates[3], rates[4] = turn.by_stiffness * (law.k / stiff), turn.by_damping * (law.b / damp)


@njit(cache=True, error_model="numpy")
def rates_of(law, x, w, force):  # type: ignore[no-untyped-def]
    """The same of one axis in state ``x`` at the reference's angular frequency ``w`` [rad/s]."""
    stiff, damp, rates = law.k * (1.0 + x[STIFFNESS]), law.b * (1.0 + x[DAMPING]), np.empty(RATES, np.complex128)
    set_rates(law, turn_of(law, np.exp(x[LOG]), x[PHASE], w, stiff, damp, force), stiff, damp, rates)
    return rates


@njit(cache=True, error_model="numpy")
def rate_at(rates, about, x):  # type: ignore[no-untyped-def]
    """Slow rate of one axis in state ``x``, by the rates about another state."""
    rate = rates[0] + rates[1] * (x[PHASE] - about[PHASE]) + rates[2] * (x[LOG] - about[LOG])
    return rate + rates[3] * (x[STIFFNESS] - about[STIFFNESS]) + rates[4] * (x[DAMPING] - about[DAMPING])


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})
def flow(rates, about, x, h, taken):  # type: ignore[no-untyped-def]
    """One axis over ``h`` seconds, in place on its state ``x``, by the slow rates about the state ``about``.

    Args:
        rates: see ``rates_of``. taken: filled with what phase and ln A take from the first five states, (2, 5).
    """
    by_phase, by_log, stiff, damp = rates[1], rates[2], rates[3], rates[4]
    trace = by_phase.imag + by_log.real
    det = by_phase.imag * by_log.real - by_phase.real * by_log.imag
    # exp(a h) and its first two integrals, each p + q a, by their series; the h here is a fraction of the decay time
    p0, q0, p1, q1, p2, q2, p, q = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0
    for n in range(9):
        one = h / (n + 1)
        two = one * h / (n + 2)
        p0, q0, p1, q1, p2, q2 = p0 + p, q0 + q, p1 + p * one, q1 + q * one, p2 + p * two, q2 + q * two
        p, q = -det * q * one, (p + trace * q) * one
    rate = rate_at(rates, about, x)
    gone = p1 * rate + q1 * (by_phase * rate.imag + by_log * rate.real)
    turned = by_phase * stiff.imag + by_log * stiff.real
    by_stiffness, by_trend = p1 * stiff + q1 * turned, p2 * stiff + q2 * turned
    by_damping = p1 * damp + q1 * (by_phase * damp.imag + by_log * damp.real)
    x[PHASE] += gone.imag + by_trend.imag * x[TREND]
    x[LOG] += gone.real + by_trend.real * x[TREND]
    x[STIFFNESS] += h * x[TREND]
    taken[0, PHASE], taken[0, LOG] = p0 + q0 * by_phase.imag, q0 * by_log.imag
    taken[1, PHASE], taken[1, LOG] = q0 * by_phase.real, p0 + q0 * by_log.real
    taken[0, STIFFNESS], taken[1, STIFFNESS] = by_stiffness.imag, by_stiffness.real
    taken[0, TREND], taken[1, TREND] = by_trend.imag, by_trend.real
    taken[0, DAMPING], taken[1, DAMPING] = by_damping.imag, by_damping.real


@njit(cache=True, error_model="numpy")
def _walked(P, taken, h, walk):  # type: ignore[no-untyped-def]
    """Add to one axis's covariance (STATES, STATES) what it walks at random in a step of ``h`` seconds.

    walk: spectral densities of white noise on phase and ln A [1/s], trend [1/s^3], damping [1/s], gain [1/s].
    """
    early = 0.25 * taken[0, TREND], 0.25 * taken[1, TREND], 0.5 * h, 1.0  # what a kick in the middle becomes
    for i, kicked in enumerate(early):
        for j, too in enumerate(early):
            P[i, j] += walk[1] * h * kicked * too
    P[DAMPING, DAMPING] += walk[2] * h
    P[GAIN, GAIN] += walk[3] * h
    for i in range(2):
        half = 0.5 * taken[i, DAMPING]
        P[i, i] += (walk[0] + walk[2] * half * half) * h
        P[i, DAMPING] += walk[2] * h * half
        P[DAMPING, i] += walk[2] * h * half


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
def carried(rows, taken, h):  # type: ignore[no-untyped-def]
    """Multiply one axis's ``rows`` (STATES, n) of a matrix, in place, from the left by the Jacobian of its step."""
    for v in range(rows.shape[1]):
        phase, log = 0.0, 0.0
        for j in range(DAMPING + 1):
            phase += taken[0, j] * rows[j, v]
            log += taken[1, j] * rows[j, v]
        rows[PHASE, v], rows[LOG, v] = phase, log
        rows[STIFFNESS, v] += h * rows[TREND, v]


@njit(cache=True, error_model="numpy")
def _composed(first, second, h):  # type: ignore[no-untyped-def]
    """What phase and ln A take over two steps, the first of ``h`` seconds, into ``first``."""
    for j in range(DAMPING + 1):
        phase, log = first[0, j], first[1, j]
        for i in range(2):
            own = second[i, j] + (h * second[i, STIFFNESS] if j == TREND else 0.0) if j > LOG else 0.0
            first[i, j] = second[i, PHASE] * phase + second[i, LOG] * log + own


@njit(cache=True)
def change(x, about, step):  # type: ignore[no-untyped-def]
    """Largest change of a state; a trend's by what it makes of the stiffness over a block of ``step`` seconds."""
    most = 0.0
    for i in range(x.size):
        moved = abs(x[i] - about[i])
        most = max(most, moved * step if i % STATES == TREND else moved)
    return most


@njit(cache=True, error_model="numpy")
def _parts(rates, h):  # type: ignore[no-untyped-def]
    """Parts of a step of ``h`` seconds over which the slow rates are straight enough in the state.

    One but for what follows a switch: there phase and amplitude run to where the new drive holds them.
    """
    bent = (abs(rates[1]) + abs(rates[2])) * h * (abs(rates[0]) * h) ** 2 / 6.0
    return int(np.ceil(min(np.sqrt(bent / STRAIGHT), MOST_PARTS))) if bent > STRAIGHT else 1


@njit(cache=True, error_model="numpy")
def _go(laws, signal, k, a, h, walk, linear, x, P, taken):  # type: ignore[no-untyped-def]
    """Axis ``a`` over ``h`` seconds of block k's drive, in place on the whole state and its covariance."""
    at, law = a * STATES, law_of(laws[a])
    own, about, rates = x[at : at + STATES], linear.about[k, at : at + STATES], linear.rates[k, a]
    if not change(own, about, signal.step) < NONLINEAR:
        about = own.copy()
        rates = rates_of(law, own, signal.w[k, a], signal.force[k, a])
    parts = _parts(rates, h)
    for i in range(parts):
        further = taken if i == 0 else np.empty((2, DAMPING + 1))
        if i > 0:
            bound(laws, signal, x)
            about = own.copy()
            rates = rates_of(law, own, signal.w[k, a], signal.force[k, a])
        flow(rates, about, own, h / parts, further)
        carried(P[at : at + STATES], further, h / parts)
        carried(P.T[at : at + STATES], further, h / parts)
        _walked(P[at : at + STATES, at : at + STATES], further, h / parts, walk)
        if i > 0:
            _composed(taken, further, i * h / parts)


@njit(cache=True, error_model="numpy")
def leave(laws, signal, k, x, P, walk, linear, taken):  # type: ignore[no-untyped-def]
    """State and covariance, in place, from block k's middle to where the next block's drive begins.

    Args:
        linear: ``linear.Linear``, of block k at least. taken: see ``flow``, of each axis, shape (axes, 2, 5).
    """
    for a in range(len(laws)):
        law, at, h = law_of(laws[a]), a * STATES, signal.step * signal.share[k, a]
        _go(laws, signal, k, a, h, walk[a], linear, x, P, taken[a])
        # against the next block's reference, continued straight to where its drive begins
        psi = signal.psi[k, a] + h * signal.w[k, a]
        x[at + PHASE] += psi - (signal.psi[k + 1, a] - (signal.step - h) * signal.w[k + 1, a])
        if signal.share[k, a] != 0.5:
            x[at + PHASE], x[at + LOG] = _switched(law, x[at : at + STATES], signal, k, a)
    bound(laws, signal, x)


@njit(cache=True, error_model="numpy")
def ahead(laws, signal, k, x, linear):  # type: ignore[no-untyped-def]
    """About where ``arrive`` will come to, from where ``leave`` left."""
    out = x.copy()
    for a in range(len(laws)):
        at, h = a * STATES, signal.step * (1.0 - signal.share[k, a])
        rate = linear.rates[k, a, 0]
        out[at + PHASE] += h * (rate.imag + signal.w[k, a] - signal.w[k + 1, a])
        out[at + LOG] += h * rate.real
        out[at + STIFFNESS] += h * x[at + TREND]
    bound(laws, signal, out)
    return out


@njit(cache=True, error_model="numpy")
def arrive(laws, signal, k, x, P, walk, offset_walk, linear, taken):  # type: ignore[no-untyped-def]
    """State and covariance, in place, on to the middle of block k + 1; ``taken`` becomes that of the whole step."""
    later = np.empty((2, DAMPING + 1))
    for a in range(len(laws)):
        h = signal.step * (1.0 - signal.share[k, a])
        _go(laws, signal, k + 1, a, h, walk[a], linear, x, P, later)
        _composed(taken[a], later, signal.step - h)
    bound(laws, signal, x)
    offset = STATES * len(laws)
    P[offset, offset] += offset_walk * signal.step
    for a in range(len(laws)):
        for i, most in ((a * STATES + PHASE, UNKNOWN[0]), (a * STATES + LOG, UNKNOWN[1])):
            if P[i, i] > most * most:
                scale = most / np.sqrt(P[i, i])
                P[i, :] *= scale
                P[:, i] *= scale


@njit(cache=True, error_model="numpy")
def bound(laws, signal, x):  # type: ignore[no-untyped-def]
    """Keep each amplitude, in place, between no motion and the largest that a line can tell."""
    for a in range(len(laws)):
        floor, top = np.log(FLOOR * law_of(laws[a]).theta0), np.log(signal.ladder[a, 0, -1])
        x[a * STATES + LOG] = min(max(x[a * STATES + LOG], floor), top)
