"""A readout that clips."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scanner.terms.term import Parameter, Scales, Term, View

Array = NDArray[np.float64]


def _clipped(size: Array, limit: float, noise: float) -> Array:
    """Mean of min(size + noise, limit): the noise is added before the clipping, so its mean is bent as well."""
    from scipy.special import ndtr

    z = (limit - size) / noise
    density = np.exp(-0.5 * np.minimum(z * z, 700.0)) / np.sqrt(2.0 * np.pi)
    return limit - noise * (z * ndtr(z) + density)


def _noise(s: Scales) -> float:
    """What the readout states, which may be too little: it lies on the signal before that is clipped."""
    stated = s.readout.noise_sd if s.readout else 0.0
    return stated or 1e-6 * s.sense_peak


def output(signal: Array, p: Sequence[float], view: View) -> Array:
    return np.sign(signal) * _clipped(np.abs(signal), p[0], p[1])


TERM = Term(
    effect="saturation",
    stage="readout",
    equation="y = clip(y_nominal, −L, L)",
    parameters=(
        Parameter("limit", "V", lambda s: s.sense_peak, kind="log", spread=0.2, starts=(0.0, -0.4, -1.2)),
        Parameter("noise", "V", _noise, kind="log", spread=0.5),
    ),
    source="converter data sheets: input range",
    lookalikes={"sensor-cubic": "no flat top in the histogram there: look at the largest samples"},
    output=output,
)
