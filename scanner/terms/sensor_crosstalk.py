"""A sensor of motion, or its electronics, that also responds to the other axis.

The crosstalk is a fraction of the other channel, whose size is measured, and not of the other axis's angle: the gain of
a sensor and the torque of its axis are known from each other only, and would imitate any change of such a fraction.
"""

from __future__ import annotations

from collections.abc import Sequence

from scanner.arrays import Array
from scanner.terms.term import Parameter, SignalContext, Term


def output(signal: Array, p: Sequence[float], context: SignalContext) -> Array:
    (c,) = p
    return signal + c * (context.other - context.other.mean())


TERM = Term(
    effect="sensor-crosstalk",
    stage="readout",
    equation="y = y_nominal + c (y_other − ȳ_other)",
    parameters=(Parameter("c", "1", lambda s: 0.03),),
    source="IEEE Std 1293 (2018): cross-axis sensitivity of a sensor of motion",
    confounders={
        "cross-axis-coupling": "coupling of the mirror has this axis's resonance in it, crosstalk none: drive the "
        "other axis at this one's resonance"
    },
    applies=lambda axis, scales: scales.two_axes and axis.readout is not None,
    output=output,
    channels=("sense", "angle"),
    coupled=True,
)
