"""Values at the nodes of integration steps: the start, the middle and the end of every step.

The Runge-Kutta method evaluates a drive at these three times. Two neighbouring steps may have different values at their
common time, so that a jump between them is represented exactly.
"""

from __future__ import annotations

import numpy as np

from scanner.arrays import Array


def to_nodes(half_steps: Array) -> Array:
    """Return values given at every half step, shape (2 n + 1,), by step and node, shape (n, 3)."""
    return np.stack([half_steps[:-2:2], half_steps[1::2], half_steps[2::2]], axis=1)


def from_nodes(nodes: Array) -> Array:
    """Return values by step and node, shape (n, 3), at every half step, shape (2 n + 1,). Inverse of :func:`to_nodes`.

    Where two steps differ at the time that they share, the value of the later step is taken.
    """
    return np.append(nodes[:, :2].ravel(), nodes[-1, 2])


def nodes_to_samples(nodes: Array) -> Array:
    """Return values by step and node, shape (n, 3), at the starts of all steps and the end, shape (n + 1,)."""
    return np.append(nodes[:, 0], nodes[-1, 2])
