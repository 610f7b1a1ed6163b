"""The edges that a detector in the beam's path would give: crossings with hysteresis, jitter, losses and bounces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanner.arrays import Array


@dataclass(frozen=True)
class SyncDetector:
    """A detector that switches when the beam passes it.

    Attributes:
        angle: of the mirror at which the beam passes [rad].
        hysteresis: the angle by which it switches late, in either direction [rad].
        jitter: standard deviation of an edge [s].
        missing: probability that an edge is lost.
        doubled: probability that an edge is repeated, ``bounce`` [s] later.
        bounce: [s].
    """

    angle: float = 0.0
    hysteresis: float = 0.0
    jitter: float = 0.0
    missing: float = 0.0
    doubled: float = 0.0
    bounce: float = 1e-7


def sync_edges(
    angle: Array, rate: float, detector: SyncDetector, rng: np.random.Generator, start: float = 0.0
) -> Array:
    """Return the edge times of a detector under a motion, shape (edges,) [s].

    The crossing between two samples is that of the cubic through the four nearest ones.

    Args:
        angle: true angle, shape (n,) [rad].
        rate: its sample rate [Hz], at least 16 samples a period.
        detector: that the beam crosses.
        rng: of jitter, losses and bounces.
        start: time of the first sample [s].
    """
    times = []
    for sign in (1.0, -1.0):
        beyond = sign * (angle - detector.angle) - detector.hysteresis
        before = np.flatnonzero((beyond[1:-2] < 0.0) & (beyond[2:-1] >= 0.0)) + 1
        a, b, c, d = (beyond[before + i] for i in (-1, 0, 1, 2))
        u = b / (b - c)
        for _ in range(4):  # Newton steps on the cubic through the four samples
            c1, c2, c3 = -a / 3 - b / 2 + c - d / 6, a / 2 - b + c / 2, (d - a) / 6 + (b - c) / 2
            u -= (b + u * (c1 + u * (c2 + u * c3))) / (c1 + u * (2 * c2 + 3 * u * c3))
        times.append(start + (before + u) / rate)
    edges = np.sort(np.concatenate(times))
    edges = edges + rng.normal(0.0, detector.jitter, edges.size)
    edges = edges[rng.random(edges.size) >= detector.missing]
    return np.sort(np.concatenate([edges, edges[rng.random(edges.size) < detector.doubled] + detector.bounce]))
