"""Hum of the mains as part of the noise model: its lines and their priors."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from scanner.arrays import Array

FEW_HARMONICS = 3
"""Number of harmonics of most hum, the n-th with a prior of 1/n, as rectifiers cause them."""

WEAK_HUM_RELATIVE_SD = 0.5
"""Prior standard deviation of the two quadratures of hum in standard deviations of the noise: weaker than the noise."""

STRONG_HUM_RELATIVE_SD = 3.0
"""The same for hum that is stronger than the noise."""


class Mains(NamedTuple):
    """Mains whose hum is part of the noise model.

    Attributes:
        frequency: [Hz].
        harmonics: number of harmonics.
        relative_sd: prior standard deviation of the two quadratures of the first one, relative to that of the noise.
        cost: -2 log of posterior over prior density of a frequency that was fitted; 0 for a nominal one.
    """

    frequency: float
    harmonics: int = FEW_HARMONICS
    relative_sd: float = WEAK_HUM_RELATIVE_SD
    cost: float = 0.0


NOMINAL_MAINS = (Mains(50.0), Mains(60.0))
"""Mains at their nominal frequencies. Their harmonics are part of the noise model, not an effect; a strong tone without
harmonics is interference."""


@lru_cache(maxsize=16)
def hum_quadratures(frequency: float, harmonics: int, n: int, step: float) -> dict[str, Array]:
    """Quadratures of the first harmonics of the mains, the n-th with amplitude 1/n, by name."""
    phase = 2 * np.pi * step * np.arange(n)
    return {
        f"{name} of {multiple} x {frequency!r} Hz": wave(frequency * multiple * phase) / multiple
        for multiple in range(1, harmonics + 1)
        for name, wave in (("cos", np.cos), ("sin", np.sin))
    }


def is_hum(name: str) -> bool:
    """Whether an additive waveform with this name is a quadrature of hum."""
    return name.endswith(" Hz")
