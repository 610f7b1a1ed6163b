"""Demodulator sections whose corner frequencies differ from the data sheet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from scanner.device import Axis
from scanner.stages import Amdm
from scanner.terms.term import Parameter, Term


def constants(axis: Axis, p: Sequence[float]) -> Axis:
    (s,) = p
    readout = axis.require_readout()
    if not isinstance(readout, Amdm):
        return axis
    return replace(axis, readout=replace(readout, lpf_hz=tuple(s * corner for corner in readout.lpf_hz)))


TERM = Term(
    effect="filter-lag",
    stage="readout",
    equation="y = a_cir Π 1/(1 + i f/(s f_i)) C + b_cir",
    parameters=(Parameter("s", "1", lambda s: 1.0, kind="factor", spread=0.15),),
    source="chen2020, section II-C and appendix: sections of 40.8 and 41.1 kHz",
    confounders={"channel-delay": "a delay leaves the size of the harmonics unchanged: sweep the drive's frequency"},
    constants=constants,
    applies=lambda axis, scales: isinstance(scales.readout, Amdm),
)
