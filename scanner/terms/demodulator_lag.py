"""Sections of a demodulator that its data sheet leaves out: the envelope detector's own and the low-pass behind it."""

from __future__ import annotations

from collections.abc import Sequence
from math import pi

from scanner.device import Amdm
from scanner.terms.term import Parameter, Term


def corners(p: Sequence[float]) -> tuple[float, ...]:
    return (p[0], p[0])


TERM = Term(
    effect="demodulator-lag",
    stage="readout",
    equation="y = a_cir C/(1 + i f/f_c)² + b_cir",
    parameters=(Parameter("f_c", "Hz", lambda s: 15.0 * s.rate / (2.0 * pi), kind="inverse", sign=1),),
    source="chen2020, section II-C and appendix: two sections near 41 kHz, which the paper takes for a constant phase",
    lookalikes={
        "channel-delay": "phase over the drive's frequency, and the harmonics' size: sweep the drive",
        "readout-lag": "one section turns a line by 90 degrees at most, two by 180: drive faster",
    },
    corners=corners,
    applies=lambda axis, scales: isinstance(scales.readout, Amdm) and not scales.readout.lpf_hz,
)
