"""Parametric resonance: the slow flow of amplitude and phase, the threshold, the tongue, the steady branch.

With theta = A sin(psi + phi), psi half the drive's phase, averaging the equation of motion (chen2020 eq 9) over a
period of the motion leaves two slow equations. The Gaussian capacitance is kept whole: the averages are taken
numerically, not by a series in theta.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanner.device import Axis
from scanner.laws import capacitance_slope, electrostatic_torque

Array = NDArray[np.float64]

_TURN = 2.0 * np.pi * np.arange(128) / 128  # one period of the motion; exact for harmonics below the 64th


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
    """offset + amplitude sin(2 pi f t); chen2020 drives with 30 V + 30 V sin."""
    return DriveShape(frequency, lambda phase: offset + amplitude * np.sin(phase))


def slow_flow(
    axis: Axis, drive: DriveShape, amplitude: float, phase: float, b: float | None = None, k: float | None = None
) -> tuple[float, float]:
    """Rates of amplitude [rad/s] and phase [rad/s] of theta = A sin(psi + phi), averaged over a period.

    Args:
        b, k: damping and stiffness where they have drifted from the axis's own.
    """
    mechanics, comb = axis.require_mechanics(), axis.require_capacitance()
    b = mechanics.b if b is None else b
    k = mechanics.k if k is None else k
    w = np.pi * drive.frequency
    turn = _TURN + phase
    theta, omega = amplitude * np.sin(turn), amplitude * w * np.cos(turn)
    slope = capacitance_slope(theta, comb.C0, comb.theta0, comb.theta_th)
    torque = electrostatic_torque(slope, drive.voltage(2.0 * _TURN))
    force = (torque - b * omega - k * theta) / mechanics.J + w * w * theta
    return float(np.mean(force * np.cos(turn)) / w), float(-np.mean(force * np.sin(turn)) / (w * amplitude))


def stiffness_modulation(axis: Axis, drive: DriveShape) -> float:
    """delta: electrostatic stiffness at the drive's frequency over the mean stiffness, for small angles."""
    mechanics, comb = axis.require_mechanics(), axis.require_capacitance()
    per_volt2 = comb.C0 / comb.theta0**2  # -C''(theta_th) / 2
    square = drive.voltage(2.0 * _TURN) ** 2
    line = abs(np.mean(square * np.exp(-2j * _TURN))) * 2.0
    return float(per_volt2 * line / (mechanics.k + per_volt2 * np.mean(square)))


def threshold(axis: Axis) -> float:
    """The modulation of stiffness above which rest is unstable at exact parametric resonance: delta = 2/Q."""
    return 2.0 / axis.quality


def tongue_edges(axis: Axis, drive: DriveShape) -> tuple[float, float] | None:
    """Drive frequencies [Hz] between which rest is unstable; None below the threshold.

    First order in delta: f_dr = 2 f (1 -+ sqrt(delta^2/4 - 1/Q^2) / 2), f the small-angle resonance under the mean V^2.
    """
    mechanics, comb = axis.require_mechanics(), axis.require_capacitance()
    delta = stiffness_modulation(axis, drive)
    square = float(np.mean(drive.voltage(2.0 * _TURN) ** 2))
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
    """Amplitude [rad] and phase [rad, modulo pi] of the stable large oscillation; None where there is none.

    Newton on the slow flow from several starts; a root is stable when both eigenvalues of its Jacobian have a
    negative real part. Of several stable roots the largest is the one that a downward sweep reaches.
    """
    from scipy.optimize import root

    def flow(state: Array) -> Array:
        amplitude = float(np.exp(np.clip(state[0], -12.0, 1.0)))  # Newton may throw its first step far out
        rate_a, rate_p = slow_flow(axis, drive, amplitude, float(state[1]), b, k)
        return np.array([rate_a / amplitude, rate_p])

    best: tuple[float, float] | None = None
    for a0 in (guess, 2.0 * guess, 0.5 * guess, 0.25 * guess):
        for p0 in np.deg2rad([-10.0, -25.0, -40.0, 80.0]):
            found = root(flow, np.array([np.log(a0), p0]))
            if not found.success or np.abs(flow(found.x)).max() > 1e-3:
                continue
            step = 1e-6
            jacobian = np.column_stack(
                [(flow(found.x + step * unit) - flow(found.x - step * unit)) / (2 * step) for unit in np.eye(2)]
            )
            amplitude, phase = float(np.exp(found.x[0])), float(found.x[1])
            if (
                np.linalg.eigvals(jacobian).real.max() < 0.0
                and 1e-4 < amplitude < 1.5
                and (best is None or amplitude > best[0])
            ):
                best = amplitude, float((phase + np.pi / 2) % np.pi - np.pi / 2)
    return best
