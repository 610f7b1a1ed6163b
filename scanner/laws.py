"""The physical laws of one axis, defined once for simulator, estimators and diagnosis.

Every function takes scalars or arrays. Those that compiled code calls are compiled by numba; the capacitance is not,
because numpy evaluates the exponentials of an array faster. Angles are in rad, other values in SI units.
"""

from __future__ import annotations

import numpy as np
from numba import njit


def capacitance(theta, C0, Cb, theta0, theta_th):  # type: ignore[no-untyped-def]
    """Comb capacitance C(theta) = C0 exp(-((theta - theta_th)/theta0)^2) + Cb [F] (chen2020 eq 13)."""
    u = (theta - theta_th) / theta0
    return C0 * np.exp(-u * u) + Cb


@njit(cache=True, nogil=True, error_model="numpy")
def gaussian_slope(u, gaussian, C0, theta0):  # type: ignore[no-untyped-def]
    """dC/dtheta [F/rad] from u = (theta - theta_th)/theta0 and gaussian = exp(-u^2)."""
    return -2.0 * u / theta0 * C0 * gaussian


@njit(cache=True, nogil=True)
def capacitance_slope(theta, C0, theta0, theta_th):  # type: ignore[no-untyped-def]
    """dC/dtheta [F/rad]."""
    u = (theta - theta_th) / theta0
    return gaussian_slope(u, np.exp(-u * u), C0, theta0)


@njit(cache=True, nogil=True, error_model="numpy")
def electrostatic_torque(slope, voltage):  # type: ignore[no-untyped-def]
    """Torque 1/2 C'(theta) V^2 [N m] (chen2020 eq 8), towards the largest capacitance."""
    return 0.5 * slope * voltage * voltage


@njit(cache=True, nogil=True, error_model="numpy")
def angular_acceleration(theta, omega, torque, J, b, k):  # type: ignore[no-untyped-def]
    """J theta'' + b theta' + k theta = torque, solved for theta'' [rad/s2] (chen2020 eq 9)."""
    return (torque - b * omega - k * theta) / J


@njit(cache=True, nogil=True)
def transimpedance_voltage(slope, omega, R_s, V_bias):  # type: ignore[no-untyped-def]
    """Readout -R_s V_bias C'(theta) theta' [V] (chen2019 eq 2, 9)."""
    return -R_s * V_bias * slope * omega


@njit(cache=True, nogil=True)
def amdm_voltage(filtered_capacitance, a_cir, b_cir):  # type: ignore[no-untyped-def]
    """Demodulated readout a_cir C + b_cir [V] of the capacitance after the low-pass sections (chen2020 eq 25)."""
    return a_cir * filtered_capacitance + b_cir


@njit(cache=True, nogil=True)
def motion_voltage(motion, gain, offset):  # type: ignore[no-untyped-def]
    """Readout gain q + offset [V] of the motion q: the angle, its rate or its acceleration."""
    return gain * motion + offset
