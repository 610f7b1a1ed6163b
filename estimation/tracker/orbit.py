"""One axis in motion, averaged over a turn: its slow flow, its own harmonics, and what a capacitance or a sensor sees.

The motion is theta = A sin(u) + small harmonics, u = psi + phi with psi the reference phase. Over one turn of u the
torque is known from the drive's harmonics; its part at n u drives the motion's n-th harmonic (harmonic balance, one
step: the third is 0.1 to 0.2 % of A, its square no longer matters), and its part at u, the harmonics' feedback
included, moves amplitude and phase:

    r = d(ln A)/dt + i dphi/dt = (i F1 / A + J w^2 - k - i w b - J (r^2 + r')) / (2 i w J + b),

torque at u = Re(F1 exp(i u)). Left out of the phase, the third harmonic alone costs 0.05 to 0.1 degrees. The rate's
own square and change are small unless the motion slips against its reference: in a free decay that the reference is
1 % off, they are 1 degree in 4 ms.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from estimation.bell import bell
from scanner.device import Axis, Position, Readout

Array = NDArray[np.float64]

POINTS = 32  # a turn; exact for harmonics below the 16th
QUARTER = POINTS // 4
SENSED = 8  # highest harmonic of the readout that is used
MOVED = 5  # highest harmonic of the motion that is modelled
DRIVEN = 4  # harmonics of the drive's force, the mean included

_TURN = 2.0 * np.pi * np.arange(POINTS) / POINTS
COS = np.cos(np.arange(SENSED + 1)[:, None] * _TURN)
SIN = np.sin(np.arange(SENSED + 1)[:, None] * _TURN)


class AxisLaw(NamedTuple):
    """One axis in numbers, for compiled code.

    Attributes:
        J, b, k: mechanics. C0, Cb, theta0, theta_th: comb; C0 = 0 where there is none.
        pull: half for an electrostatic drive (torque pull C' V^2), 0 for a linear one.
        push: torque per volt of a linear drive, 0 for an electrostatic one.
        turn: harmonics of the reference in one of the drive's force: 2 where psi is half the drive's phase, else 1.
        position: whether the readout sees the angle itself.
    """

    J: float
    b: float
    k: float
    C0: float
    Cb: float
    theta0: float
    theta_th: float
    pull: float
    push: float
    turn: int
    position: bool


def axis_law(axis: Axis, readout: Readout) -> AxisLaw:
    """The numbers of one axis behind one readout.

    Raises:
        DeviceInvalid: a needed value is missing.
    """
    mechanics, drive = axis.require_mechanics(), axis.require_drive()
    electrostatic, position = drive.kind == "electrostatic", isinstance(readout, Position)
    bell = (0.0, 0.0, 1.0, 0.0)
    if electrostatic or not position:
        comb = axis.require_capacitance()
        bell = (comb.C0, comb.Cb, comb.theta0, comb.theta_th)
    pull, push, turn = (0.5, 0.0, 2) if electrostatic else (0.0, float(drive.torque_per_volt or 0.0), 1)
    return AxisLaw(mechanics.J, mechanics.b, mechanics.k, *bell, pull, push, turn, position)


@njit(cache=True)
def law_of(row):  # type: ignore[no-untyped-def]
    """The ``AxisLaw`` in a row of numbers: compiled code is then the same for one axis and for two."""
    return AxisLaw(row[0], row[1], row[2], row[3], row[4], row[5], row[6], row[7], row[8], int(row[9]), row[10] > 0.0)


class Turn(NamedTuple):
    """What one turn gives.

    Attributes:
        rate: d(ln A)/dt + i dphi/dt [1/s]. by_phase, by_log: its derivatives by phi and ln A.
        by_stiffness, by_damping: its derivatives by relative changes of k and b.
        moved: harmonics of the motion, theta = A sin u + sum of Re(moved[n] exp(i n u)), shape (MOVED + 1,) [rad].
        seen: harmonics of C [F] or of theta [rad], the same way, shape (SENSED + 1,). seen_by_log: derivative by ln A.
        mean_bend: second derivative of their mean by ln A.
    """

    rate: complex
    by_phase: complex
    by_log: complex
    by_stiffness: complex
    by_damping: complex
    moved: NDArray[np.complex128]
    seen: NDArray[np.complex128]
    seen_by_log: NDArray[np.complex128]
    mean_bend: float


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _line(values, n, points):  # type: ignore[no-untyped-def]
    """Coefficient of exp(i n u): values = sum of Re(line exp(i n u)), told by the first ``points`` of them."""
    even, odd = 0.0, 0.0
    for j in range(points):
        even += values[j] * COS[n, j]
        odd += values[j] * SIN[n, j]
    scale = (1.0 if n == 0 else 2.0) / points
    return complex(even * scale, -odd * scale)


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})
def turn_of(law, amplitude, phase, w, k, b, force):  # type: ignore[no-untyped-def]
    """One turn of the motion.

    Args:
        law: AxisLaw. amplitude [rad]. phase: phi [rad]. w: angular frequency of the reference [rad/s].
        k, b: stiffness and damping of the moment.
        force: harmonics of V^2 (electrostatic) or V (linear) in the drive's phase: sum of
            Re(force[m] exp(i m turn psi)), shape (DRIVEN,).

    Returns:
        Turn.
    """
    # Combs that know no side, driven twice a turn: half a turn on, motion and torque have changed their sign and the
    # capacitance is the same, so that half the points tell all there is and every other harmonic vanishes.
    half = law.theta_th == 0.0 and law.turn == 2
    points = POINTS // 2 if half else POINTS
    room = np.empty((10, POINTS))  # one allocation: ten of them took as long as all the rest
    seen_at, slope_at, bend_at, square, square_slope = room[0], room[1], room[2], room[3], room[4]
    torque, stiff, own, by_log, by_phase = room[5], room[6], room[7], room[8], room[9]
    narrow = 1.0 / law.theta0
    for j in range(QUARTER + 1):  # sin u takes each of its values twice in a turn, an even comb four times
        theta = amplitude * SIN[1, j]
        value, slope, bend = bell(theta, law.C0, law.Cb, narrow, law.theta_th)
        for i in (j, 2 * QUARTER - j):
            seen_at[i], slope_at[i], bend_at[i] = value, slope, bend
        if half:
            continue
        if law.theta_th == 0.0:
            slope = -slope
        else:
            value, slope, bend = bell(-theta, law.C0, law.Cb, narrow, law.theta_th)
        for i in ((POINTS - j) % POINTS, 2 * QUARTER + j):
            seen_at[i], slope_at[i], bend_at[i] = value, slope, bend
    for j in range(points):
        square[j], square_slope[j], own[j] = force[0].real, 0.0, 0.0
    back, turned = np.exp(-1j * law.turn * phase), 1.0 + 0.0j
    for m in range(1, DRIVEN):
        turned *= back
        if force[m] != 0.0:
            n, line = m * law.turn, force[m] * turned
            for j in range(points):
                square[j] += line.real * COS[n, j] - line.imag * SIN[n, j]
                square_slope[j] += n * (line.real * SIN[n, j] + line.imag * COS[n, j])  # by phi, at fixed u
    for j in range(points):
        torque[j] = law.pull * slope_at[j] * square[j] + law.push * square[j]
        stiff[j] = law.pull * bend_at[j] * square[j]
    moved = np.zeros(MOVED + 1, np.complex128)
    for n in range(MOVED + 1):
        if n != 1 and not (half and n % 2 == 0):
            held = k - n * n * w * w * law.J + 1j * n * w * b
            if n == 0:
                held -= _line(stiff, 0, points).real
            moved[n] = _line(torque, n, points) / held
            for j in range(points):
                own[j] += moved[n].real * COS[n, j] - moved[n].imag * SIN[n, j]
    mean_bend = 0.0
    for j in range(points):
        swing = amplitude * SIN[1, j]
        torque[j] += stiff[j] * own[j]
        by_log[j] = stiff[j] * swing
        by_phase[j] = (law.pull * (slope_at[j] + bend_at[j] * own[j]) + law.push) * square_slope[j]
        if law.position:
            seen_at[j], slope_at[j] = swing + own[j], swing
        else:
            seen_at[j] += (slope_at[j] + 0.5 * bend_at[j] * own[j]) * own[j]
            slope_at[j] = (slope_at[j] + bend_at[j] * own[j]) * swing
            mean_bend += (slope_at[j] + bend_at[j] * swing * swing) / points
    light = 1.0 / (2j * w * law.J + b)
    push = 1j / amplitude * light  # by which a torque changes the rate
    first = push * _line(torque, 1, points)
    rate = first + (law.J * w * w - k - 1j * w * b) * light
    by_phase_rate = push * _line(by_phase, 1, points)
    by_log_rate = push * _line(by_log, 1, points) - first
    change = by_phase_rate * rate.imag + by_log_rate * rate.real
    own_share = 1.0 - 2.0 * law.J * rate * light  # of a change of the rate, that its square leaves
    rate -= law.J * (rate * rate + change) * light
    seen, seen_by_log = np.zeros(SENSED + 1, np.complex128), np.zeros(SENSED + 1, np.complex128)
    for n in range(SENSED + 1):
        if not half or n % 2 == int(law.position):
            seen[n] = _line(seen_at, n, points)
            seen_by_log[n] = _line(slope_at, n, points)
    return Turn(
        rate,
        own_share * by_phase_rate,
        own_share * by_log_rate,
        own_share * -k * light,
        own_share * -1j * w * b * light,
        moved,
        seen,
        seen_by_log,
        mean_bend,
    )
