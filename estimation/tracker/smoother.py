"""Kalman filter over blocks, compiled; ``step`` carries the state between them, ``backward`` smooths what it leaves.

A block's projections are the measurement: whitened by its Gram matrix they are independent of each other, so that they
come in one at a time and nothing is inverted.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from estimation.tracker.orbit import law_of, turn_of
from estimation.tracker.step import (
    DAMPING,
    GAIN,
    LOG,
    PHASE,
    STATES,
    STIFFNESS,
    TREND,
    TRIES,
    bounded,
    predict,
)

LOST = (0.5, 0.3)  # sd of phase [rad] and ln A beyond which the block itself tells where the motion is
SIGNIFICANT = 6.0  # standard deviations that a line must have to be taken for a motion
MISFIT = 4.0  # mean squared innovation beyond which the motion itself must have jumped
BROKEN = 100.0  # beyond which it is looked for anew
NONLINEAR = 2e-3  # step of phase [rad], ln A or anything else, see _change, after which a block is linearised anew
OPEN = (0.02, 3.0)  # sd of the stiffness and its trend [1/s] that a jump may at most give them


@njit(cache=True, error_model="numpy")
def expected(laws, signal, k, x):  # type: ignore[no-untyped-def]
    """Coefficients that block k's projections should show in the state ``x``, and their Jacobian (3, m, states).

    A line changes over the block as exp(rate t): the coefficients (3, m) are its value and its first two derivatives,
    the last one halved. In a free decay the second is worth half a degree. The rate follows stiffness and damping, so
    that a block off its middle tells of them: left out of the Jacobian, an error of 0.1 % in k looks like a jump.
    """
    m = signal.roots.shape[2]
    values, jacobian = np.zeros((3, m)), np.zeros((3, m, x.size))
    values[0, 0], jacobian[0, 0, x.size - 1] = x[x.size - 1], 1.0
    for a in range(len(laws)):
        law = law_of(laws[a])
        at = a * STATES
        stiff, damp = law.k * (1.0 + x[at + STIFFNESS]), law.b * (1.0 + x[at + DAMPING])
        turn = turn_of(law, np.exp(x[at + LOG]), x[at + PHASE], signal.w[k, a], stiff, damp, signal.force[k, a])
        by_stiff, by_damp = turn.by_stiffness * (law.k / stiff), turn.by_damping * (law.b / damp)
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
def _update(signal, k, x, P, about, values, jacobian, noise):  # type: ignore[no-untyped-def]
    """Bring block k's measurements, linearised about ``about``, into ``x`` and ``P``, one at a time.

    noise: variance of a sample [V^2].

    Returns:
        (log-likelihood, squared normalised innovations, measurements), the last two of the projections alone.
    """
    n, roots = x.size, signal.roots[signal.geometry[k]]
    whitened, m = signal.whitened[k], values.shape[1]
    PH, H = np.empty(n), np.empty(n)
    chi2, logdet, known, count = 0.0, 0.0, 0.0, 0  # a known phase that misfits is no jump of the motion
    for i in range(m):
        e, size = whitened[i], 0.0
        H[:] = 0.0
        for j in range(m):
            root = roots[0, i, j]
            size += root * root
            e -= root * values[0, j] + roots[1, i, j] * values[1, j] + roots[2, i, j] * values[2, j]
            for u in range(n):
                H[u] += root * jacobian[0, j, u] + roots[1, i, j] * jacobian[1, j, u]
                H[u] += roots[2, i, j] * jacobian[2, j, u]
        if size <= 0.0:  # a direction in which the block has no samples
            continue
        S = noise
        for u in range(n):
            held = 0.0
            for v in range(n):
                held += P[u, v] * H[v]
            PH[u] = held
            S += H[u] * held
            e -= H[u] * (x[u] - about[u])
        for u in range(n):
            gain = PH[u] / S
            x[u] += gain * e
            for v in range(n):
                P[u, v] -= gain * PH[v]
        chi2 += e * e / S
        logdet += np.log(S)
        count += 1
    for a in range(signal.psi.shape[1]):
        if np.isfinite(signal.known_var[k, a]):
            at = a * STATES + PHASE
            PH, S = P[at].copy(), P[at, at] + signal.known_var[k, a]
            period = 2.0 * np.pi / signal.main  # theta and -theta look alike to a capacitance
            e = signal.known[k, a] - x[at]
            e -= period * np.round(e / period)
            x += PH / S * e
            P -= np.outer(PH, PH) / S
            known += e * e / S + np.log(S)
    return -0.5 * (chi2 + logdet + known), chi2, count


@njit(cache=True, error_model="numpy")
def _measured(laws, signal, k, before, P_before, noise):  # type: ignore[no-untyped-def]
    """State and covariance with block k's measurements, linearised anew until they stay; what ``_update`` returns."""
    about = before
    for _ in range(TRIES):
        x, P = before.copy(), P_before.copy()
        values, jacobian = expected(laws, signal, k, about)
        here = _update(signal, k, x, P, about, values, jacobian, noise)
        if _change(x, about, signal.step) < NONLINEAR:
            break
        about = bounded(laws, signal, x)
    return x, P, here


@njit(cache=True)
def _change(x, about, step):  # type: ignore[no-untyped-def]
    """Largest change of a state; a trend's by what it makes of the stiffness over a block of ``step`` seconds."""
    most = 0.0
    for i in range(x.size):
        change = abs(x[i] - about[i])
        most = max(most, change * step if i % STATES == TREND else change)
    return most


@njit(cache=True, error_model="numpy")
def _reopen(laws, signal, k, x, P, F, misfit):  # type: ignore[no-untyped-def]
    """Let a jump in: phase, amplitude and stiffness become as uncertain as the misfit says, or are found anew."""
    scale = min(misfit, BROKEN)
    for a in range(len(laws)):
        at = a * STATES
        if misfit > BROKEN and _acquire(signal, k, a, x, P):
            F[at : at + 2, :] = 0.0
        else:
            P[at + PHASE, at + PHASE] *= scale
            P[at + LOG, at + LOG] *= scale
        for i, sd in ((at + STIFFNESS, OPEN[0]), (at + TREND, OPEN[1])):
            P[i, i] = max(P[i, i], min(P[i, i] * scale, sd * sd))


@njit(cache=True, error_model="numpy")
def run_filter(laws, signal, x, P, live, walk, offset_walk, xs, Ps, xp, Pp, Fs):  # type: ignore[no-untyped-def]
    """Filter all blocks.

    Args:
        laws: an ``AxisLaw`` a row. signal: ``Signal``.
        x, P: state before the first block. live: whether the motion of each axis was found, shape (axes,); changed.
        walk: shape (axes, 4), see ``flow``. offset_walk: [V^2/s].
        xs, Ps: filtered; xp, Pp: predicted; Fs: Jacobian of the step that leads to each block; shape (blocks, ...).

    Returns:
        (log-likelihood, sum of squared normalised innovations, measurements).
    """
    total, chi2, count = 0.0, 0.0, 0
    for k in range(signal.whitened.shape[0]):
        F = np.eye(x.size)
        if k > 0:
            P, F = predict(laws, signal, k - 1, x, P, walk, offset_walk)
        for a in range(len(laws)):
            at = a * STATES
            lost = P[at + PHASE, at + PHASE] > LOST[0] ** 2 or P[at + LOG, at + LOG] > LOST[1] ** 2
            if (not live[a] or lost) and _acquire(signal, k, a, x, P):
                F[at : at + 2, :] = 0.0
                live[a] = True
        xp[k], Pp[k], Fs[k] = x, P, F
        noise = signal.noise_var[k]
        x, P, here = _measured(laws, signal, k, xp[k], Pp[k], noise)
        misfit = here[1] / max(here[2], 1)
        if misfit > MISFIT:  # the block is clean, so the model missed a jump: it is let in
            _reopen(laws, signal, k, xp[k], Pp[k], Fs[k], misfit)
            for _ in range(TRIES):
                x, P, here = _measured(laws, signal, k, xp[k], Pp[k], noise)
                misfit = here[1] / max(here[2], 1)
                if misfit < MISFIT:
                    break
                noise *= misfit if misfit < BROKEN else BROKEN  # what no state explains counts as noise
            else:
                x, P = xp[k].copy(), Pp[k].copy()
        x = bounded(laws, signal, x)
        total, count = total + here[0], count + here[2]
        chi2 += here[1] * noise / signal.noise_var[k]
        xs[k], Ps[k] = x, P
    return total, chi2, count


@njit(cache=True, error_model="numpy")
def turns(laws, signal, xs, rates, moved):  # type: ignore[no-untyped-def]
    """Rates d(ln A)/dt + i dphi/dt (blocks, axes) and own harmonics (blocks, axes, MOVED + 1) along a track."""
    for k in range(xs.shape[0]):
        for a in range(len(laws)):
            law, x = law_of(laws[a]), xs[k, a * STATES : (a + 1) * STATES]
            stiff, damp = law.k * (1.0 + x[STIFFNESS]), law.b * (1.0 + x[DAMPING])
            turn = turn_of(law, np.exp(x[LOG]), x[PHASE], signal.w[k, a], stiff, damp, signal.force[k, a])
            rates[k, a] = turn.rate
            moved[k, a] = turn.moved
