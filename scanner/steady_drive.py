"""The sinusoidal drive at which an axis keeps swinging over its field."""

from __future__ import annotations

from math import pi, sqrt

from scanner.device import Axis

COMB_STIFFNESS, COMB_C0, COMB_THETA0, COMB_QUALITY = 9.6e-6, 5.71e-12, 0.2, 120.0
"""Stiffness [N m / rad], capacitance [F], theta0 [rad] and Q of the axes of the named device ``imaging``."""
COMB_VOLTS = 30.0
"""Amplitude and offset of the voltage that sustains an amplitude of ``COMB_AMPLITUDE_THETA0`` in these axes [V]."""
COMB_DETUNING = 0.67
"""Half the drive's frequency over the resonance, less one, times Q: where that voltage sustains that amplitude."""
COMB_AMPLITUDE_THETA0 = 0.9
"""That amplitude in units of theta0."""


def comb_frequency(resonance: float, quality: float) -> float:
    """Return the frequency of the voltage on combs that keeps a mirror near its resonance [Hz]."""
    return 2.0 * (1.0 + COMB_DETUNING / quality) * resonance


def comb_voltage(stiffness: float, quality: float, capacitance: float, theta0: float) -> float:
    """Return amplitude and offset of the voltage that sustains ``COMB_AMPLITUDE_THETA0`` theta0 [V].

    In a period the drive supplies C0 V^2 and the damping takes k theta0^2 / Q, each times a function of the amplitude
    over theta0.
    """
    loss = stiffness * theta0**2 / (quality * capacitance)
    return COMB_VOLTS * sqrt(loss * COMB_QUALITY * COMB_C0 / (COMB_STIFFNESS * COMB_THETA0**2))


def steady_drive(axis: Axis, amplitude: float) -> tuple[float, float, float]:
    """Return frequency [Hz], amplitude [V] and offset [V] of a drive at which an axis keeps swinging.

    The frequency is the one that the device states, else that of the resonance.

    Args:
        axis: with mechanics and drive.
        amplitude: that a linear drive reaches [rad]. Combs sustain ``COMB_AMPLITUDE_THETA0`` theta0.

    Raises:
        DeviceInvalid: the axis lacks mechanics, drive or, with combs, capacitance.
    """
    mechanics, drive = axis.require_mechanics(), axis.require_drive()
    if drive.kind == "electrostatic":
        comb = axis.require_capacitance()
        volts = comb_voltage(mechanics.k, mechanics.quality, comb.C0, comb.theta0)
        return drive.frequency or comb_frequency(mechanics.resonance, mechanics.quality), volts, volts
    assert drive.torque_per_volt is not None  # a linear drive of an axis with mechanics states it
    frequency = drive.frequency or mechanics.resonance
    rate = 2.0 * pi * frequency
    torque = amplitude * abs(mechanics.k - mechanics.J * rate**2 + 1j * rate * mechanics.b)
    return frequency, torque / abs(drive.torque_per_volt), 0.0
