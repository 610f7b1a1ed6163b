"""The filter's runs over a signal, and the process noise that explains it: how fast the resonance drifts, and how sure
that is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimation.tracker import backward, smoother
from estimation.tracker.linear import Linear, unmade
from estimation.tracker.signal import Prepared
from estimation.tracker.smoother import Filtered
from estimation.tracker.step import DAMPING, LOG, PHASE, STATES, TREND, Signal, padded

Array = NDArray[np.float64]

START_WALK = (1e-7, 0.1, 1e-5)  # white phase noise [rad2/s], trend [1/s3], damping [1/s]: where the tuning starts
LEAST_WALK = (1e-9, 1e-4, 1e-8)
GAIN_WALK, OFFSET_WALK = 1e-8, 1e-8  # [1/s], [V2/s]: a readout's drift is slow against the scan
TUNED_BLOCKS = 300  # in up to three stretches
ROUNDS, SETTLED = 12, 0.2  # of the tuning, and the change of a logarithm at which it ends
UNHEARD = 1e-3  # degrees of freedom that a density has in the track: below nothing tells it
PRIOR = (0.0, 1.0, 0.0)  # degrees of freedom that a density's prior adds to its score
FASTEST = 10.0  # growth of a density in a round
MOST_WALK = (1.0, 100.0, 1.0)
TRENDS = 1  # which of the three densities is the trend's
APART = 2.0  # of ln q, between the densities that are tried about the most probable one
FIRM = 30.0  # degrees of freedom in the trend from which its density is as good as known
FINE = 201  # points at which its posterior is integrated


@dataclass(frozen=True)
class Belief:
    """State and covariance before a block, and whether each axis's motion has been found."""

    x: Array
    P: Array
    live: NDArray[np.bool_]


class Part(NamedTuple):
    """Blocks of a signal, and their linearisations, which serve every run over them."""

    signal: Signal
    linear: Linear


class Likely(NamedTuple):
    """Walks that may be, and how much of each: a track between them is the straight line between theirs.

    Attributes:
        walks: shape (walks, axes, 3). mean: of each one's share over the posterior, shape (axes, walks).
        square: mean products of the shares, shape (axes, walks, walks).
    """

    walks: Array
    mean: Array
    square: Array


def densities(values: Array) -> Array:
    """Spectral densities of each axis, shape (axes, 4), from the three that are tuned."""
    return np.concatenate([values, np.full((len(values), 1), GAIN_WALK)], axis=1)


def tuned_walk(prepared: Prepared, start: Belief, parts: list[Part], walk: Array | None = None) -> Array:
    """Process noise of each axis, shape (axes, 3), see ``START_WALK``: of the trend most probable, else most likely.

    It is searched on ``parts``, from ``walk`` where one is given.

    Where the likelihood's score vanishes, a state is kicked as much as the smoothed track says (``backward.kicks``);
    until then each density grows by the ratio of the two. What has less than a degree of freedom is not waited for. The
    trend's size is taken for equally probable everywhere (Gelman, Bayesian Analysis 1, 515, 2006, of the standard
    deviation), which is half a degree of freedom more: a likelihood that is flat towards no drift at all would often
    find none.
    """
    signal, axes = prepared.signal, len(prepared.laws)
    walk = np.tile(START_WALK, (axes, 1)) if walk is None else walk
    for _ in range(ROUNDS):
        told, held = _kicked(prepared, parts, start, walk)
        freedom = held * walk * signal.step
        heard = freedom > UNHEARD
        grown = (walk * told + np.array(PRIOR) / signal.step) / np.where(heard, held, 1.0)
        new = np.where(heard, np.clip(np.minimum(grown, FASTEST * walk), LEAST_WALK, MOST_WALK), walk)
        settled = (np.abs(np.log(new / walk)) < SETTLED) | ((freedom < 1.0) & (np.array(PRIOR) == 0.0))
        walk = new
        if settled.all():
            break
    return walk


def _kicked(prepared: Prepared, parts: list[Part], start: Belief, walk: Array) -> tuple[Array, Array]:
    """Both sides of the likelihood's score by each density, see ``backward.kicks``; shapes (axes, 3)."""
    squares, spreads = np.zeros((2, padded(start.x.size)))
    for part in parts:
        told = backward.kicks(*part, filtered(prepared, *part, start, densities(walk)).blocks)
        squares, spreads = np.add((squares, spreads), told)
    return _by_walk(squares, len(walk)), _by_walk(spreads, len(walk))


def likely_walks(prepared: Prepared, start: Belief, parts: list[Part], walk: Array) -> Likely:
    """The walks that a signal's parts leave possible about the most probable one: one, or three where it tells little.

    The trend's density on either side, for all axes at once, as each axis's score is its own: the posterior's slope
    by ln q is the score and the prior's half, a parabola through three of them, and its integral the posterior.
    """
    nodes = np.array([-APART, 0.0, APART])
    walks = np.repeat(walk[None], nodes.size, axis=0)
    walks[:, :, TRENDS] *= np.exp(nodes)[:, None]
    told, held = np.empty((2, *walks.shape))
    for i in (1, 0, 2):  # the middle first: where it is firm, nothing is asked of the others
        told[i], held[i] = _kicked(prepared, parts, start, walks[i])
        freedom = (held * walks * prepared.signal.step)[:, :, TRENDS]
        if i == 1 and (freedom[1] > FIRM).all():
            return Likely(walk[None], np.ones((len(walk), 1)), np.ones((len(walk), 1, 1)))
    slopes = 0.5 * ((told * walks * prepared.signal.step)[:, :, TRENDS] - freedom) + 0.5
    g = np.linspace(nodes[0], nodes[-1], FINE)
    hats = np.stack([np.interp(g, nodes, own) for own in np.eye(nodes.size)])
    mean, square = [], []
    for own in slopes.T:
        log_density = np.polyval(np.polyint(np.polyfit(nodes, own, 2)), g)
        density = np.exp(log_density - log_density.max())
        density /= density.sum()
        mean.append(hats @ density)
        square.append((hats * density) @ hats.T)
    return Likely(walks, np.array(mean), np.array(square))


def _by_walk(sums: Array, axes: int) -> Array:
    """Sums over states as sums over what walks, shape (axes, 3): phase and ln A together, trend, damping."""
    own = sums[: axes * STATES].reshape(axes, STATES)
    return np.stack([own[:, PHASE] + own[:, LOG], own[:, TREND], own[:, DAMPING]], axis=1)


def stretches(signal: Signal) -> list[Part]:
    """The parts of a signal that its process noise is tuned on."""
    blocks, third = len(signal.whitened), TUNED_BLOCKS // 3
    starts = (0, (blocks - third) // 2, blocks - third)
    own = [signal] if blocks <= TUNED_BLOCKS else [window(signal, at, at + third) for at in starts]
    return [Part(each, unmade(each)) for each in own]


def window(signal: Signal, first: int, stop: int) -> Signal:
    """Blocks ``first`` up to ``stop`` of a signal."""
    by_block = (
        "psi",
        "w",
        "force",
        "share",
        "passed",
        "passed_by_w",
        "tuned",
        "whitened",
        "geometry",
        "noise_var",
        "known",
        "known_var",
    )
    return signal._replace(**{name: getattr(signal, name)[first:stop] for name in by_block})


class Run(NamedTuple):
    """A filter's run over a signal.

    Attributes:
        log_likelihood: of the projections. chi2: squared normalised innovations. used: measurements.
        live: whether the motion of each axis was found. blocks: what it left of them.
    """

    log_likelihood: float
    chi2: float
    used: int
    live: NDArray[np.bool_]
    blocks: Filtered


def filtered(prepared: Prepared, signal: Signal, linear: Linear, start: Belief, walk: Array) -> Run:
    """``smoother.run_filter`` from a belief; ``linear`` is of the same blocks as the signal."""
    live, n = start.live.copy(), start.x.size
    x, P = np.zeros(padded(n)), np.zeros((padded(n), padded(n)))
    x[:n], P[:n, :n] = start.x, start.P
    blocks = smoother.unfiltered(len(signal.whitened), len(prepared.laws))
    args = x, P, live, walk, OFFSET_WALK, linear, blocks
    log_likelihood, chi2, used = smoother.run_filter(prepared.rows, signal, *args)
    return Run(log_likelihood, chi2, used, live, blocks)
