"""One channel is delayed against the others."""

from __future__ import annotations

from collections.abc import Sequence

from scanner.arrays import Array
from scanner.terms.term import NATURAL_PHASE_LAG, Parameter, Term


def clock(time: Array, p: Sequence[float]) -> Array:
    (delay,) = p
    return time - delay


TERM = Term(
    effect="channel-delay",
    stage="timing",
    equation="y(t) = y_nominal(t − τ)",
    parameters=(Parameter("delay", "s", lambda s: NATURAL_PHASE_LAG / s.rate, sign=1),),
    source="chen2019, section IV: 0.114 ms between position detector and sense signal",
    confounders={
        "readout-lag": "a lag attenuates and delays each harmonic differently: use a larger drive, or two frequencies",
        "drive-lag": "a drive lag delays the angle too: record the angle",
    },
    channels=("sense", "angle"),
    stated_channels=("sync",),  # edge times; edges are no samples that a diagnosis could fit
    clock=clock,
)
