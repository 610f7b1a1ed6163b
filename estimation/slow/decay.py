"""Averaged dynamics of a free decay: the amplitude under damping laws that depend on amplitude or time.

A term's torque along theta = A sin(u) has a first harmonic that acts as a damping b_eq(A) (its describing function).
Over many turns the amplitude follows

    d ln A / dt = -(b + b_eq(A, t)) / (2 J),

which needs no integration of the turns. Source: Nayfeh and Mook, Nonlinear Oscillations (Wiley 1979), section 3.3.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from scanner.arrays import Array

GRID_STEPS = 400
"""Runge-Kutta steps over a decay; the relative error of the amplitude is below 1e-8 for ten time constants."""


@dataclass(frozen=True)
class Law:
    """An effect on the amplitude of a free decay.

    Attributes:
        effect: name in the catalogue.
        power: the rate of decay gains c (A / A_0)^power; None for a law of time.
        parameters: of the fit, dimensionless: c T, or the relative changes of a law of time.
    """

    effect: str
    power: float | None
    parameters: int = 1


LAWS = (
    Law("cubic-damping", 2.0),
    Law("quadratic-drag", 1.0),
    Law("coulomb-friction", -1.0),
    Law("damping-drift", None, 2),
)
"""Laws of the mechanics. Those of amplitude are exact averages of the catalogue's terms."""


class Decay(NamedTuple):
    """Measured amplitude of a free decay.

    Attributes:
        time: from the start, shape (n,) [s].
        log_amplitude: ln(A / first amplitude), shape (n,).
        noise_sd: standard deviation of its white noise, shape (n,).
        first_amplitude: in the unit of the measurement.
    """

    time: Array
    log_amplitude: Array
    noise_sd: Array
    first_amplitude: float


@njit(cache=True)
def _rate(t, log_a, rate, coefficient, power, drift, drift_time):  # type: ignore[no-untyped-def]
    total = rate * (1.0 - drift * np.expm1(-t / drift_time))
    if coefficient != 0.0:
        total += coefficient * np.exp(min(power * log_a, 50.0))
    return -total


@njit(cache=True)
def solve_decay(start, rate, coefficient, power, drift, drift_time, steps):  # type: ignore[no-untyped-def]
    """ln A at ``steps`` + 1 times of the unit interval, by Runge-Kutta steps of order 4, shape (steps + 1,)."""
    out, h = np.empty(steps + 1), 1.0 / steps
    out[0] = start
    for i in range(steps):
        t, y = i * h, out[i]
        k1 = _rate(t, y, rate, coefficient, power, drift, drift_time)
        k2 = _rate(t + 0.5 * h, y + 0.5 * h * k1, rate, coefficient, power, drift, drift_time)
        k3 = _rate(t + 0.5 * h, y + 0.5 * h * k2, rate, coefficient, power, drift, drift_time)
        k4 = _rate(t + h, y + h * k3, rate, coefficient, power, drift, drift_time)
        out[i + 1] = max(y + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4), -60.0)
    return out


def log_amplitude(shared: Array, start: float, log_floor: float, law: Law | None, time: Array) -> Array:
    """ln of the measured amplitude over the reference amplitude, noise floor included, at ``time`` in units of T.

    Args:
        shared: of all decays of a device: ln of rate times T, and the parameters of the law.
        start: ln of the amplitude at time 0, over the reference amplitude.
        log_floor: ln of the floor over the reference amplitude.
        law: None for a constant rate.
        time: not after 1, shape (n,).
    """
    coefficient, power, drift, drift_time = 0.0, 1.0, 0.0, 1.0
    if law is not None and law.power is not None:
        coefficient, power = float(shared[1]), law.power
    elif law is not None:
        drift, drift_time = float(shared[1]), float(np.exp(shared[2]))
    solved = solve_decay(start, float(np.exp(shared[0])), coefficient, power, drift, drift_time, GRID_STEPS)
    clean = np.interp(time, np.linspace(0.0, 1.0, GRID_STEPS + 1), solved)
    return 0.5 * np.logaddexp(2.0 * clean, 2.0 * log_floor)
