"""What drifts while a scan is taken: factors on stiffness, damping and drive as functions of time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Factor = Callable[[Array], Array]


def steady(time: Array) -> Array:
    """The factor of what does not drift: 1 at all times."""
    return np.ones_like(time)


def settling(change: float, tau: float) -> Factor:
    """1 + change (1 - exp(-t/tau)) from t = 0 on, 1 before: how a mirror warms to a new temperature.

    Args:
        change: relative change in the end; of stiffness, it moves the resonance by half of it.
        tau: time constant [s].
    """
    return lambda time: 1.0 - change * np.expm1(-np.maximum(time, 0.0) / tau)


@dataclass(frozen=True)
class Drift:
    """Factors over time [s] on the recording's clock, array in, array out.

    Attributes:
        stiffness: on k; the resonance follows its square root.
        damping: on b.
        drive: on the drive voltage; with ``damping`` it sets how the amplitude drifts.
    """

    stiffness: Factor = steady
    damping: Factor = steady
    drive: Factor = steady
