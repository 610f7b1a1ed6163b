"""Sections of a demodulator that its data sheet leaves out: envelope detector and output low-pass."""

from __future__ import annotations

from collections.abc import Sequence
from math import pi

from scanner.stages import Amdm
from scanner.terms.term import NATURAL_PHASE_LAG, Parameter, Term


def corners(p: Sequence[float]) -> tuple[float, ...]:
    (f_c,) = p
    return (f_c, f_c)


TERM = Term(
    effect="demodulator-lag",
    stage="readout",
    equation="y = a_cir C/(1 + i f/f_c)² + b_cir",
    parameters=(  # each of the two sections has half of the phase
        Parameter("f_c", "Hz", lambda s: s.rate / (2.0 * pi * 0.5 * NATURAL_PHASE_LAG), kind="inverse", sign=1),
    ),
    source="chen2020, section II-C and appendix: two sections near 41 kHz, which the paper treats as a constant phase",
    confounders={
        "channel-delay": "a delay leaves the size of the harmonics unchanged: sweep the drive's frequency",
        "readout-lag": "one section delays the phase by at most 90 degrees, two by 180: drive at a higher frequency",
    },
    corners=corners,
    applies=lambda axis, scales: isinstance(scales.readout, Amdm) and not scales.readout.lpf_hz,
)
