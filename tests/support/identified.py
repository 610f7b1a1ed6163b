"""Truth of identified values: a recorded decay under a bias, and the coverage of intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache

import numpy as np

from benchmarks.papers.threshold import sensing_axis
from estimation.identification.agreement import IdentifiedValue
from phantoms.forward import InitialState, Plan, simulate_trajectory
from phantoms.waveforms import Constant
from scanner.forward_model import sense_signal


@cache
def decay_under_bias() -> tuple[np.ndarray, np.ndarray]:
    """Noiseless decay of the chen2019 device under its bias, at 500 kHz: angle [rad] and sense signal [V]."""
    axis = sensing_axis()
    plan = Plan({"x": Constant(10.0)}, 0.08, 500e3, substeps=4)
    path = simulate_trajectory(axis, plan, InitialState(0.15, 0.0), 0.0, 0.08)
    return path.angle[:-1:4], sense_signal(axis.require_readout(), [path])[:-1:4]


def coverage(draws: Sequence[Mapping[str, IdentifiedValue]], truth: Mapping[str, float]) -> dict[str, float]:
    """Share of the draws whose 95 % interval contains the true value, by name."""
    return {key: np.mean([d[key].ci95[0] < value < d[key].ci95[1] for d in draws]) for key, value in truth.items()}
