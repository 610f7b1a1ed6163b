"""The equation of motion, integrated: the trajectories behind every simulated recording."""

from __future__ import annotations

import numpy as np
from numba import njit

from scanner.laws import angular_acceleration, capacitance_slope, electrostatic_torque


@njit(cache=True)
def _acceleration(theta, omega, v, J, b, k, C0, theta0, theta_th, torque_per_volt):  # type: ignore[no-untyped-def]
    torque = torque_per_volt * v
    if C0 > 0.0:
        torque += electrostatic_torque(capacitance_slope(theta, C0, theta0, theta_th), v)
    return angular_acceleration(theta, omega, torque, J, b, k)


@njit(cache=True)
def rk4(theta, omega, voltage, b, k, step, stride, J, C0, theta0, theta_th, torque_per_volt):  # type: ignore[no-untyped-def]
    """Classical Runge-Kutta of order 4 over one axis.

    Args:
        theta, omega: state at the start [rad, rad/s].
        voltage, b, k: drive voltage [V], damping [N m s] and stiffness [N m/rad] at the start, middle and end of
            every step: shape (2 n + 1,), so that nothing is interpolated inside a step.
        step: [s].
        stride: every ``stride``-th step is kept.
        J, C0, theta0, theta_th: inertia [kg m2] and capacitance law; ``C0 = 0`` for a linear drive.
        torque_per_volt: [N m/V]; 0 for an electrostatic drive.

    Returns:
        (angle, rate): shape (n // stride + 1,), the start included.
    """
    n = (voltage.size - 1) // 2
    angle = np.empty(n // stride + 1)
    rate = np.empty(n // stride + 1)
    angle[0], rate[0] = theta, omega
    half = 0.5 * step
    for i in range(n):
        v0, v1, v2 = voltage[2 * i], voltage[2 * i + 1], voltage[2 * i + 2]
        b0, b1, b2 = b[2 * i], b[2 * i + 1], b[2 * i + 2]
        k0, k1, k2 = k[2 * i], k[2 * i + 1], k[2 * i + 2]
        a1 = _acceleration(theta, omega, v0, J, b0, k0, C0, theta0, theta_th, torque_per_volt)
        w2 = omega + half * a1
        a2 = _acceleration(theta + half * omega, w2, v1, J, b1, k1, C0, theta0, theta_th, torque_per_volt)
        w3 = omega + half * a2
        a3 = _acceleration(theta + half * w2, w3, v1, J, b1, k1, C0, theta0, theta_th, torque_per_volt)
        w4 = omega + step * a3
        a4 = _acceleration(theta + step * w3, w4, v2, J, b2, k2, C0, theta0, theta_th, torque_per_volt)
        theta += step / 6.0 * (omega + 2.0 * w2 + 2.0 * w3 + w4)
        omega += step / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)
        if (i + 1) % stride == 0:
            angle[(i + 1) // stride], rate[(i + 1) // stride] = theta, omega
    return angle, rate
