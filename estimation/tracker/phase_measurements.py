"""Phases that were measured by other means than the sense signal, for instance in the picture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from math import pi, sqrt
from typing import NamedTuple

import numpy as np

from estimation.tracker.observations import BlockObservations
from scanner.arrays import Array

UNKNOWN_PHASE_SD = pi / sqrt(12)
"""Standard deviation of a phase of which nothing is known but that it lies within half a turn [rad]."""


class PhaseMeasurement(NamedTuple):
    """Measurements of one axis's phase; each is assigned to the middle of the block that it falls in.

    Attributes:
        time: shape (n,) [s]. phase: as in ``AxisMotion``, shape (n,) [rad].
        sd: standard deviations, shape (n,) [rad]. Values with NaN, or with an infinite sd, are ignored.
    """

    time: Array
    phase: Array
    sd: Array


def with_phase_measurements(
    observations: BlockObservations, phases: Mapping[str, PhaseMeasurement]
) -> BlockObservations:
    """The observations with phase measurements by axis; several in one block are replaced by their weighted mean."""
    signal = observations.signal
    external_phase, external_var = signal.external_phase.copy(), signal.external_var.copy()
    for a, name in enumerate(observations.sense.axes):
        if name in phases:
            time, phase, sd = phases[name]
            used = np.isfinite(phase) & np.isfinite(sd)
            block = np.round((time[used] - observations.time[0]) / signal.step).astype(np.int64)
            inside = (block >= 0) & (block < observations.time.size)
            weight = 1.0 / sd[used][inside] ** 2
            total = np.bincount(block[inside], weight, observations.time.size)
            weighted_sum = np.bincount(block[inside], weight * phase[used][inside], observations.time.size)
            measured = total > 0.0
            external_phase[measured, a] = weighted_sum[measured] / total[measured]
            external_var[measured, a] = 1.0 / total[measured]
    return replace(observations, signal=signal._replace(external_phase=external_phase, external_var=external_var))
