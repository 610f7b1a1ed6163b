"""How much of a channel depends on what its signal was before the first sample, or is after the last one."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import inf, isfinite, pi

import numpy as np

from scanner.active_terms import ActiveTerm, stated_terms, with_constants
from scanner.device import Axis
from scanner.stages import Amdm

SETTLE_TIME_CONSTANTS = 20.0
"""Time constants after which the transient of a low-pass section is negligible: exp(-20) = 2e-9."""


def settling_time(channel: str, axes: Sequence[Axis], duration: float = 0.0) -> tuple[float, float]:
    """Return the times at the start and at the end of a channel at which a model of the recording alone is wrong [s].

    At the start a delay reads the signal before the first sample, and low-pass sections contain their response to it.
    At the end a signal that comes early is read after the last sample.

    Args:
        channel: ``"sense"`` or one of ``scanner.forward_model.REFERENCE_ORDERS``.
        axes: whose motion the channel contains, with the terms that they state and the readout that senses them.
        duration: of the channel [s].

    Raises:
        BadInput: as :func:`scanner.active_terms.stated_terms`.
    """
    terms = [each for axis in axes for each in stated_terms(axis)]
    acting = [each for each in terms if each.channel.partition(":")[0] == channel]
    corners = [corner for each in acting if each.term.corners for corner in each.term.corners(each.values)]
    if channel == "sense":
        corners += _sections(axes[0], terms)
    slowest = min((abs(corner) for corner in corners if isfinite(corner)), default=inf)
    ends = np.array([0.0, duration])
    shifts = [each.term.clock(ends, each.values) - ends for each in acting if each.term.clock]
    late, early = sum(max(0.0, -float(start)) for start, _ in shifts), sum(max(0.0, float(end)) for _, end in shifts)
    return late + SETTLE_TIME_CONSTANTS / (2.0 * pi * slowest), early


def _sections(axis: Axis, terms: Iterable[ActiveTerm]) -> tuple[float, ...]:
    """Corner frequencies of the sections of a readout, with the constants that terms change [Hz]."""
    readout = with_constants(axis, (each for each in terms if each.term.stage == "readout")).readout
    return readout.lpf_hz if isinstance(readout, Amdm) else ()
