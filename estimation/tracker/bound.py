"""The posterior Cramer-Rao bound of the slow motion: what no estimator can beat (derived in docs/bound.md).

The information of every single sample about phase, amplitude, gain and offset is gathered along the true trajectory,
with no demodulation and no block model, and carried through the process by the recursion of Tichavsky, Muravchik and
Nehorai (IEEE Trans. Signal Process. 46, 1386, 1998); a smoother's bound is the backward pass of that recursion.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimation.tracker.backward import run_smoother
from estimation.tracker.blocks import offsets
from estimation.tracker.linear import linearise, predict, unmade
from estimation.tracker.orbit import SENSED, law_of, turn_of
from estimation.tracker.signal import Prepared
from estimation.tracker.smoother import unfiltered
from estimation.tracker.step import DAMPING, GAIN, LOG, PHASE, STATES, STIFFNESS, padded
from scanner.harmonics import readout_response

Array = NDArray[np.float64]

UNBOUNDED = (-np.inf, np.inf)


def phase_bound(
    prepared: Prepared,
    states: Array,
    P: Array,
    walk: Array,
    noise_var: float,
    rails: tuple[float, float] = UNBOUNDED,
) -> tuple[Array, Array]:
    """Least standard deviations of phi that a filter and a smoother can have, each of shape (blocks, axes) [rad].

    Args:
        states: the true states at the blocks' middles, shape (blocks, states), see ``step``.
        P: covariance before the first block.
        walk: the true process's spectral densities, shape (axes, 4); the offset stands still.
        noise_var: of a sample [V^2].
        rails: beyond which nothing but the side of a sample is known [V].
    """
    blocks, n = states.shape
    rows, signal = prepared.rows, prepared.signal
    own, left = unmade(signal), unfiltered(blocks, len(rows))
    carried, x = np.zeros((padded(n), padded(n))), np.zeros(padded(n))
    carried[:n, :n] = P
    left.states[:], left.predicted_states[:] = 0.0, 0.0
    x[:n] = states[0]
    linearise(rows, signal, 0, x, own)
    for k in range(blocks):
        if k > 0:
            x[:n] = states[k - 1]
            predict(rows, signal, k - 1, x, carried, walk, 0.0, own, left.taken[k])
        left.predicted_covariances[k] = carried
        information = _information(prepared, k, states[k], noise_var, rails)
        carried[:n, :n] = np.linalg.inv(np.linalg.inv(carried[:n, :n]) + information)
        left.covariances[k] = carried
    phases = [a * STATES + PHASE for a in range(len(rows))]
    filtered = np.sqrt(np.diagonal(left.covariances, axis1=1, axis2=2)[:, phases])
    run_smoother(signal.step, left)
    return filtered, np.sqrt(np.diagonal(left.covariances, axis1=1, axis2=2)[:, phases])


def share_kept(h: Array, rails: tuple[float, float], sd: float) -> Array:
    """Fisher information that samples of ``h`` keep of theirs where beyond ``rails`` only the side is known, (n,).

    With z the distance from h to a rail over sd, g and Q the normal density and upper tail: what the chance to be
    inside leaves, less z g for the chosen values, and g^2 / Q for being beyond (Tobin, Econometrica 26, 24, 1958).
    """
    from scipy.stats import norm

    out = np.ones(h.shape)
    for z in ((rails[1] - h) / sd, (h - rails[0]) / sd):
        near = np.clip(z, -30.0, 30.0)
        out += np.exp(2.0 * norm.logpdf(near) - norm.logsf(near)) - near * norm.pdf(near) - norm.sf(near)
    return out


def _information(prepared: Prepared, k: int, x: Array, noise_var: float, rails: tuple[float, float]) -> Array:
    """Fisher information of all samples of block ``k``, shape (states, states)."""
    signal, channel = prepared.signal, prepared.sense.channel
    length = round(signal.step * channel.sample_rate)
    offset = offsets(length, channel.sample_rate)
    gradient, h = np.zeros((x.size, length)), np.full(length, x[-1])
    gradient[-1] = 1.0
    orders = np.arange(SENSED + 1)
    for a, law in enumerate(prepared.laws):
        at = a * STATES
        turn = turn_of(
            law_of(prepared.rows[a]),
            np.exp(x[at + LOG]),
            x[at + PHASE],
            signal.w[k, a],
            law.k,
            law.b,
            signal.force[k, a],
        )
        w = signal.w[k, a] + turn.rate.imag
        u = signal.psi[k, a] + x[at + PHASE] + w * offset
        passed = readout_response(prepared.sense.readout, orders * w / (2 * np.pi))
        turned = passed[:, None] * np.exp(1j * orders[:, None] * u)
        h += np.exp(x[at + GAIN]) * np.real(turn.seen @ turned)
        gradient[at + PHASE] = np.real((1j * orders * turn.seen) @ turned)
        gradient[at + LOG] = np.real(turn.seen_by_log @ turned)
        gradient[at + GAIN] = np.real(turn.seen[1:] @ turned[1:])
        for state, by in ((STIFFNESS, turn.by_stiffness), (DAMPING, turn.by_damping)):  # off the middle, by the rate
            gradient[at + state] = offset * (by.imag * gradient[at + PHASE] + by.real * gradient[at + LOG])
    if rails == UNBOUNDED:
        return gradient @ gradient.T / noise_var
    return gradient * share_kept(h, rails, float(np.sqrt(noise_var))) @ gradient.T / noise_var
