"""Uncertainty of a law's coefficient in SI units by that of the values with which it is converted."""

from __future__ import annotations

import numpy as np

from estimation.diagnosis.finding import ParameterEstimate
from estimation.least_squares import Z_95
from scanner.device import DEFAULT_TOLERANCE, Axis


def relative_unit_sd(axis: Axis, gain_tolerance: float, amplitude_power: float, rate_power: float = 0.0) -> float:
    """Relative standard deviation of J A^amplitude_power w^rate_power with w = sqrt(k / J).

    A motion determines laws of the torque over the inertia, at amplitudes as a sensor states them.

    Args:
        axis: that states mechanics.
        gain_tolerance: relative standard uncertainty of the amplitudes A.
        amplitude_power, rate_power: powers of A and of the angular frequency w.
    """
    inertia, stiffness = (axis.tolerance.get(key, DEFAULT_TOLERANCE) for key in ("J", "k"))
    parts = (1.0 - 0.5 * rate_power) * inertia, 0.5 * rate_power * stiffness, amplitude_power * gain_tolerance
    return float(np.linalg.norm(parts))


def law_estimate(name: str, unit: str, value: float, sd: float, relative_sd: float = 0.0) -> ParameterEstimate:
    """Value with its 95 % interval by the sd of the fit, in the same unit, and by a relative one of its unit."""
    spread = Z_95 * float(np.hypot(sd, relative_sd * value))
    return ParameterEstimate(name, value, (value - spread, value + spread), unit)
