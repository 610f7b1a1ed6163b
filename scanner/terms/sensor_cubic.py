"""A sensor whose gain depends on its own signal."""

from __future__ import annotations

from collections.abc import Sequence

from scanner.arrays import Array
from scanner.terms.term import Parameter, SignalContext, Term


def output(signal: Array, p: Sequence[float], context: SignalContext) -> Array:
    (c3,) = p
    return signal * (1.0 + c3 * signal * signal)


TERM = Term(
    effect="sensor-cubic",
    stage="readout",
    equation="y = y_nominal (1 + c3 y_nominal²)",
    parameters=(Parameter("c3", "1/V^2", lambda s: 0.1 / s.sense_peak**2),),
    source="wang2019, section II: piezoresistive sensor",
    confounders={
        "cubic-stiffness": "the spring's third harmonic falls with the square of frequency: drive at two frequencies",
        "saturation": "saturation makes a flat top in the histogram: look at the largest samples",
    },
    output=output,
)
