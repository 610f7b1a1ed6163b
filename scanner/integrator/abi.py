"""The calling convention of compiled term laws: their numba signatures and the nominal values that they receive.

A law is a numba function compiled with one of the two signatures below. The integrator calls it through its address, so
a new law needs no new integrator.
"""

from __future__ import annotations

from typing import NamedTuple

from numba import types

from scanner.device import Axis

_f8, _vector = types.float64, types.float64[::1]


class Nominal(NamedTuple):
    """Nominal values of one axis, as a law receives them: ``nominal.k``.

    Attributes:
        J: moment of inertia [kg m^2].
        b: damping [N m s].
        k: stiffness [N m / rad].
        C0, theta0, theta_th: Gaussian part of the capacitance [F, rad, rad]; 0, 1 and 0 for an axis without one.
        torque_per_volt: of a linear drive [N m / V]; 0 for an axis without one.
    """

    J: float
    b: float
    k: float
    C0: float
    theta0: float
    theta_th: float
    torque_per_volt: float


NOMINAL_TYPE = types.NamedUniTuple(_f8, len(Nominal._fields), Nominal)
"""numba's type of :class:`Nominal`."""

TORQUE_LAW = types.UniTuple(_f8, 3)(_f8, _f8, _f8, _f8, _f8, _f8, _f8, _vector, NOMINAL_TYPE)
"""(t, theta, omega, other, volt, z0, z1, p, nominal) -> (torque [N m], dz0/dt, dz1/dt).

t: time on the recording's clock [s]. theta, omega: angle and rate [rad, rad/s]. other: angle of the other axis [rad].
volt: drive [V]. z0, z1: the law's own hidden states. p: its parameters. nominal: a :class:`Nominal`."""

CAPACITANCE_LAW = types.UniTuple(_f8, 2)(_f8, _vector, NOMINAL_TYPE)
"""(theta, p, nominal) -> (additional capacitance [F], its slope [F/rad]); arguments as in ``TORQUE_LAW``."""

LANES = 8
"""Motions that are integrated together: two AVX registers or one AVX-512 register of doubles."""

MAX_TERMS_PER_STAGE = 4
"""Torque laws that can act together, and capacitance laws that can. A device with more than four at once has not been
needed, and the kernel has one call in its source for each."""


def nominal_values(axis: Axis) -> Nominal:
    """Return the nominal values of an axis in the form that a law receives.

    Raises:
        DeviceInvalid: the device states no mechanics of the axis.
    """
    mechanics, comb, drive = axis.require_mechanics(), axis.capacitance, axis.drive
    gaussian = (comb.C0, comb.theta0, comb.theta_th) if comb else (0.0, 1.0, 0.0)
    torque_per_volt = (drive.torque_per_volt or 0.0) if drive and drive.kind == "linear" else 0.0
    return Nominal(*map(float, (mechanics.J, mechanics.b, mechanics.k, *gaussian, torque_per_volt)))
