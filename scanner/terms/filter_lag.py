"""Demodulator sections that are not where the data sheet says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from scanner.device import Amdm, Axis
from scanner.terms.term import Parameter, Term


def constants(axis: Axis, p: Sequence[float]) -> Axis:
    readout = axis.require_readout()
    if not isinstance(readout, Amdm):
        return axis
    return replace(axis, readout=replace(readout, lpf_hz=tuple(p[0] * corner for corner in readout.lpf_hz)))


TERM = Term(
    effect="filter-lag",
    stage="readout",
    equation="y = a_cir Π 1/(1 + i f/(s f_i)) C + b_cir",
    parameters=(Parameter("s", "1", lambda s: 1.0, kind="factor", spread=0.15),),
    source="chen2020, section II-C and appendix: sections of 40.8 and 41.1 kHz",
    lookalikes={"channel-delay": "phase over the drive's frequency, and the harmonics' size: sweep the drive"},
    constants=constants,
    applies=lambda axis, scales: isinstance(scales.readout, Amdm),
)
