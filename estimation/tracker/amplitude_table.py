"""Start value of the amplitude: the table that relates it to the size of the main line of the signal."""

from __future__ import annotations

import numpy as np

from estimation.signals import is_capacitive
from estimation.tracker.averaged_dynamics import COS, POINTS_PER_CYCLE, SIN
from scanner.arrays import Array
from scanner.device import Axis
from scanner.laws import capacitance
from scanner.stages import Readout

AMPLITUDE_TABLE_SIZE = 400
"""Entries of the table from line magnitude to amplitude. It gives start values only."""

MAX_AMPLITUDE_THETA0 = 1.6
"""Largest amplitude of the table in units of theta0; the second line of a Gaussian comb has its maximum before it."""


def amplitude_table(axis: Axis, readout: Readout) -> Array:
    """Amplitudes [rad] and magnitudes of their main line, shape (2, AMPLITUDE_TABLE_SIZE).

    Beyond the largest magnitude, where a larger motion has a smaller line, the table is constant.
    """
    if not is_capacitive(readout):
        amplitudes = np.linspace(0.0, 2.0, AMPLITUDE_TABLE_SIZE)
        return np.stack([amplitudes, amplitudes])
    comb = axis.require_capacitance()
    amplitudes = np.linspace(1e-4, MAX_AMPLITUDE_THETA0, AMPLITUDE_TABLE_SIZE) * comb.theta0
    values = capacitance(amplitudes[:, None] * SIN[1], comb.C0, comb.Cb, comb.theta0, comb.theta_th)
    sizes = np.abs(values @ COS[2]) * (2.0 / POINTS_PER_CYCLE)
    top = int(sizes.argmax())
    return np.stack([np.minimum(amplitudes, amplitudes[top]), np.maximum.accumulate(sizes)])
