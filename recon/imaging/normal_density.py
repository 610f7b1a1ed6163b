"""Logarithm of the normal density, without ``scipy.stats``, which takes 0.3 s of every start to import."""

from __future__ import annotations

import numpy as np

from scanner.arrays import Array


def normal_log_density(x: Array | float, sd: Array | float = 1.0) -> Array:
    """Return the logarithm of the density of a normal distribution of mean 0, of the shape of ``x`` and ``sd``."""
    return np.asarray(-0.5 * np.square(np.asarray(x) / sd) - np.log(np.sqrt(2.0 * np.pi) * np.asarray(sd)))
