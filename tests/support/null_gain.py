"""Gain of the best law in noise alone, against which the detection threshold of the diagnosis is set."""

from __future__ import annotations

import numpy as np

from estimation.candidate_terms.linear_model import LinearModel

DRAWS, SEED = 10_000, 1
"""Draws of noise, which determine the 99.9 % quantile to 0.4, and the seed of them."""


def null_gain(linear: LinearModel, probability: float) -> float:
    """Fall of -2 log evidence that the best of all laws exceeds in noise alone with the given probability.

    The misfit of noise alone is a standard normal vector in the space of the sensitivities.
    """
    noise = np.random.default_rng(SEED).normal(size=(linear.factor.shape[0], DRAWS))
    largest = np.full(DRAWS, -np.inf)
    for law in linear.laws:
        columns = linear.factor[:, law.columns]
        normal = columns.T @ columns + np.eye(law.columns.size)
        projected = columns.T @ noise
        gain = np.einsum("id,id->d", projected, np.linalg.solve(normal, projected))
        largest = np.maximum(largest, gain - np.linalg.slogdet(normal)[1] - law.cost)
    return float(np.quantile(largest, 1.0 - probability)) if linear.laws else 0.0
