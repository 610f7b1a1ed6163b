"""A readout that clips."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scanner.arrays import Array
from scanner.terms.term import Parameter, SignalContext, Term


def _clipped(size: Array, limit: float, noise: float) -> Array:
    """Mean of min(size + noise, limit): the noise is added before the clipping, which changes its mean."""
    from scipy.special import ndtr

    if noise == 0.0:
        return np.minimum(size, limit)
    z = (limit - size) / noise
    density = np.exp(-0.5 * np.minimum(z * z, 700.0)) / np.sqrt(2.0 * np.pi)
    return limit - noise * (z * ndtr(z) + density)


def output(signal: Array, p: Sequence[float], context: SignalContext) -> Array:
    (limit,) = p
    noise = context.readout.noise_sd if context.readout else 0.0
    if context.variant:
        side = 1.0 if context.variant == "upper" else -1.0
        return side * _clipped(side * signal, limit, noise)
    return np.sign(signal) * _clipped(np.abs(signal), limit, noise)


ONE_RAIL = ("sense:upper", "sense:lower")
"""Channels on which one rail alone clips, at a level of any sign: min(y, L) and max(y, -L)."""

TERM = Term(
    effect="saturation",
    stage="readout",
    equation="y = clip(y_nominal, −L, L); variant 1: min(y_nominal, L), variant 2: max(y_nominal, −L)",
    parameters=(
        Parameter(
            "limit",
            "V",
            lambda s: s.sense_peak,
            kind="log",
            spread=0.2,
            starts=(0.0, -0.4, -1.2),
            any_sign_on=ONE_RAIL,
        ),
    ),
    source="converter data sheets: input range",
    confounders={"sensor-cubic": "a cubic sensor makes no flat top in the histogram: look at the largest samples"},
    output=output,
    stated_channels=ONE_RAIL,
    after_noise=True,
)
