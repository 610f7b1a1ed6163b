"""A readout that clips."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scanner.terms.term import Parameter, Term, View

Array = NDArray[np.float64]


def _clipped(size: Array, limit: float, noise: float) -> Array:
    """Mean of min(size + noise, limit): the noise is added before the clipping, so its mean is bent as well."""
    from scipy.special import ndtr

    if noise == 0.0:
        return np.minimum(size, limit)
    z = (limit - size) / noise
    density = np.exp(-0.5 * np.minimum(z * z, 700.0)) / np.sqrt(2.0 * np.pi)
    return limit - noise * (z * ndtr(z) + density)


def output(signal: Array, p: Sequence[float], view: View) -> Array:
    noise = view.readout.noise_sd if view.readout else 0.0
    return np.sign(signal) * _clipped(np.abs(signal), p[0], noise)


TERM = Term(
    effect="saturation",
    stage="readout",
    equation="y = clip(y_nominal, −L, L)",
    parameters=(Parameter("limit", "V", lambda s: s.sense_peak, kind="log", spread=0.2, starts=(0.0, -0.4, -1.2)),),
    source="converter data sheets: input range",
    lookalikes={"sensor-cubic": "no flat top in the histogram there: look at the largest samples"},
    output=output,
    at_output=True,
)
