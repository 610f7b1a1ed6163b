"""Drifts during a scan: factors on stiffness, damping and drive as functions of time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from scanner.arrays import Array

Factor = Callable[[Array], Array]
"""Time (n,) [s] -> factor (n,)."""


def constant(time: Array) -> Array:
    """Return the factor of a value that does not drift: 1 at all times, shape of ``time``."""
    return np.ones_like(time)


def exponential(change: float, tau: float) -> Factor:
    """Return the factor 1 + change (1 - exp(-t/tau)) for t > 0, 1 before: relaxation to a new temperature.

    Args:
        change: relative change in the end. A change of stiffness moves the resonance by half of it.
        tau: time constant [s].
    """
    return lambda time: np.asarray(1.0 - change * np.expm1(-np.maximum(time, 0.0) / tau), np.float64)


@dataclass(frozen=True)
class Drift:
    """Factors on the values of one axis, as functions of time on the recording's clock.

    Attributes:
        stiffness: on k; the resonance follows its square root.
        damping: on b.
        drive: on the drive voltage; together with ``damping`` it determines how the amplitude drifts.
    """

    stiffness: Factor = constant
    damping: Factor = constant
    drive: Factor = constant
