"""Parametric resonance: averaged equations of amplitude and phase, threshold, instability tongue, steady state.

With theta = A sin(psi + phi), where psi is half the drive's phase, averaging the equation of motion (chen2020 eq 9)
over a period of the motion gives two slow equations. The averages are computed numerically from the whole Gaussian
capacitance, not from a series in theta.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from scanner.arrays import Array
from scanner.device import Axis
from scanner.laws import capacitance_slope, electrostatic_torque

_PHASE = 2.0 * np.pi * np.arange(128) / 128  # one period of the motion; exact for harmonics below the 64th


@dataclass(frozen=True)
class DriveShape:
    """One period of a periodic drive voltage as a function of its phase.

    Attributes:
        frequency: of the drive; the motion is at half of it [Hz].
        voltage: phase of the drive [rad] -> voltage [V].
    """

    frequency: float
    voltage: Callable[[Array], Array]


def sine_drive(frequency: float, amplitude: float, offset: float) -> DriveShape:
    """Return the drive offset + amplitude sin(2 pi f t) [V]; chen2020 uses 30 V for both."""
    return DriveShape(frequency, lambda phase: offset + amplitude * np.sin(phase))


def slow_flow(
    axis: Axis, drive: DriveShape, amplitude: float, phase: float, b: float | None = None, k: float | None = None
) -> tuple[float, float]:
    """Return the rates of amplitude [rad/s] and phase [rad/s] of theta = A sin(psi + phi), averaged over a period.

    Args:
        axis: nominal values.
        drive: periodic voltage.
        amplitude, phase: A and phi [rad].
        b, k: damping and stiffness, where they differ from the nominal ones.
    """
    mechanics, comb = axis.require_mechanics(), axis.require_capacitance()
    b = mechanics.b if b is None else b
    k = mechanics.k if k is None else k
    w = np.pi * drive.frequency
    turn = _PHASE + phase
    theta, omega = amplitude * np.sin(turn), amplitude * w * np.cos(turn)
    slope = capacitance_slope(theta, comb.C0, comb.theta0, comb.theta_th)
    torque = electrostatic_torque(slope, drive.voltage(2.0 * _PHASE))
    force = (torque - b * omega - k * theta) / mechanics.J + w * w * theta
    return float(np.mean(force * np.cos(turn)) / w), float(-np.mean(force * np.sin(turn)) / (w * amplitude))


def stiffness_modulation(axis: Axis, drive: DriveShape) -> float:
    """Return delta: amplitude of the electrostatic stiffness at the drive's frequency over the mean stiffness.

    It holds for small angles.
    """
    mechanics, comb = axis.require_mechanics(), axis.require_capacitance()
    per_volt2 = comb.C0 / comb.theta0**2  # -C''(theta_th) / 2
    square = drive.voltage(2.0 * _PHASE) ** 2
    line = abs(np.mean(square * np.exp(-2j * _PHASE))) * 2.0
    return float(per_volt2 * line / (mechanics.k + per_volt2 * np.mean(square)))


def threshold(axis: Axis) -> float:
    """Return the stiffness modulation above which rest is unstable at exact parametric resonance: delta = 2/Q."""
    return 2.0 / axis.quality


def tongue_edges(axis: Axis, drive: DriveShape) -> tuple[float, float] | None:
    """Return the drive frequencies [Hz] between which rest is unstable; None below the threshold.

    First order in delta: f_dr = 2 f (1 -+ sqrt(delta^2/4 - 1/Q^2) / 2), f the small-angle resonance under the mean V^2.
    """
    mechanics, comb = axis.require_mechanics(), axis.require_capacitance()
    delta = stiffness_modulation(axis, drive)
    square = float(np.mean(drive.voltage(2.0 * _PHASE) ** 2))
    stiff = mechanics.k + comb.C0 / comb.theta0**2 * square
    f = np.sqrt(stiff / mechanics.J) / (2.0 * np.pi)
    loss = mechanics.b / np.sqrt(stiff * mechanics.J)
    inside = 0.25 * delta**2 - loss**2
    if inside <= 0.0:
        return None
    half = 0.5 * np.sqrt(inside)
    return 2.0 * f * (1.0 - half), 2.0 * f * (1.0 + half)


def steady_state(
    axis: Axis, drive: DriveShape, k: float | None = None, b: float | None = None, guess: float = 0.15
) -> tuple[float, float] | None:
    """Return amplitude [rad] and phase [rad, modulo pi] of the stable large oscillation; None where there is none.

    Solves the averaged equations by Newton's method from several starting points. A root is stable when both
    eigenvalues of its Jacobian have a negative real part. Of several stable roots the largest is returned, which a
    downward frequency sweep reaches.

    Args:
        axis: nominal values.
        drive: periodic voltage.
        k, b: stiffness and damping, where they differ from the nominal ones.
        guess: amplitude around which the starting points lie [rad].
    """
    from scipy.optimize import root

    def slow_rates(state: Array) -> Array:
        amplitude = float(
            np.exp(np.clip(state[0], -12.0, 1.0))
        )  # the first step of Newton's method may be far too large
        amplitude_rate, phase_rate = slow_flow(axis, drive, amplitude, float(state[1]), b, k)
        return np.array([amplitude_rate / amplitude, phase_rate])

    best: tuple[float, float] | None = None
    for a0 in (guess, 2.0 * guess, 0.5 * guess, 0.25 * guess):
        for p0 in np.deg2rad([-10.0, -25.0, -40.0, 80.0]):
            solution = root(slow_rates, np.array([np.log(a0), p0]))
            if not solution.success or np.abs(slow_rates(solution.x)).max() > 1e-3:
                continue
            step = 1e-6
            jacobian = np.column_stack(
                [
                    (slow_rates(solution.x + step * unit) - slow_rates(solution.x - step * unit)) / (2 * step)
                    for unit in np.eye(2)
                ]
            )
            amplitude, phase = float(np.exp(solution.x[0])), float(solution.x[1])
            if (
                np.linalg.eigvals(jacobian).real.max() < 0.0
                and 1e-4 < amplitude < 1.5
                and (best is None or amplitude > best[0])
            ):
                best = amplitude, float((phase + np.pi / 2) % np.pi - np.pi / 2)
    return best
