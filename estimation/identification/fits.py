"""Device parameters from calibration recordings, with standard deviations (chen2020 IV-A, chen2019 IV-B).

A ringdown determines k/J and b/J only: J, k and b scaled by one factor give the same ringdown. The scale comes from
driven motion, where inertia balances a torque ½ C'(θ) V² of known size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estimation.identification.agreement import (
    Differences,
    IdentifiedValue,
    amplitude_columns,
    difference_by_extra_columns,
    widen,
)
from estimation.identification.classification import shows_motion
from estimation.least_squares import Z_95, fit_linear
from scanner.arrays import Array
from scanner.device import Axis
from scanner.errors import BadInput
from scanner.integrator.trajectories import integrate
from scanner.laws import capacitance_slope, electrostatic_torque
from scanner.lock_in import block_length, block_phasors
from scanner.stages import Mechanics

BLOCK_CYCLES = 20.0
"""Cycles of the motion per block of a driven record, whose phasors are one equation: harmonics and noise average
out."""

MAX_AMPLITUDE_CHANGE = 0.02
"""Relative change of amplitude within a segment above which it is no steady motion and is left out. Segments of steady
motion whose amplitudes differ by less count as of one amplitude."""

STEPS_PER_CYCLE = 80
"""Samples per cycle in the fit of a ringdown, and Runge-Kutta steps under a bias: the relative error of the frequency
is then 3e-7. Without a bias the trajectory is exact."""

MAX_RINGDOWN_RESIDUAL_RATIO = 0.3
"""Standard deviation of a ringdown's residual, relative to the signal, above which the fit is rejected, unless
the residual is white noise."""

MIN_INVERSE_INERTIA = 1e-3
"""Least 1/J of a decay under a bias, relative to the stated one: there the bias has no visible effect."""

SETTLE_TIME_S = 1e-4
"""Time that low-pass sections of usual corner frequencies (40 kHz) need to settle, with a margin."""


@dataclass(frozen=True)
class DrivenRecord:
    """A segment of driven motion at one drive frequency.

    Attributes:
        angle: shape (n,) [rad]. voltage: on the combs at the same samples [V].
        frequency: of the motion [Hz]. rate: of the samples [Hz].
    """

    angle: Array
    voltage: Array
    frequency: float
    rate: float


def drive_torque(axis: Axis, record: DrivenRecord) -> Array:
    """Torque of the drive at the samples of a record, shape (n,) [N m]."""
    drive = axis.require_drive()
    if drive.kind == "linear":
        return (drive.torque_per_volt or 0.0) * record.voltage
    comb = axis.require_capacitance()
    return electrostatic_torque(capacitance_slope(record.angle, comb.C0, comb.theta0, comb.theta_th), record.voltage)


def torque_is_linear(axis: Axis) -> bool:
    """Whether the torque does not depend on the angle.

    The uncertain width of a comb makes an error of the torque that depends on the amplitude, as a spring that is not
    linear does. Therefore driven motion tests the linear law only under a torque that does not depend on the angle.
    """
    return axis.require_drive().kind == "linear"


def fit_mechanics(axis: Axis, records: Sequence[DrivenRecord]) -> dict[str, IdentifiedValue]:
    """``J``, ``b``, ``k`` and their ratios from driven motion, by chen2020 eq 9 at the motion's frequency.

    A block's phasors of angle and torque obey (k/J - w^2 + j w b/J) Θ = T / J, linear in k/J, b/J and 1/J. Phase and
    amplitude at one drive frequency give two equations, so two frequencies are needed. From three frequencies on, a
    dependence of k and b on the amplitude is tested.

    Args:
        axis: its drive and its capacitance set the torque; its mechanics are not used.
        records: of steady motion.

    Raises:
        BadInput: one frequency only, or as ``check_driven_signs``.
    """
    frequencies = {round(record.frequency, 3) for record in records}
    if len(frequencies) < 2:
        raise BadInput(
            "driven records at two or more drive frequencies are needed to determine k, b and J", hint="sweep"
        )
    rows, extra, targets, amplitudes = [], [], [], []
    for record in records:
        w = 2 * np.pi * record.frequency
        block = block_length(record.frequency, record.rate, BLOCK_CYCLES)
        theta, torque = (
            block_phasors(values, record.rate, 0.0, record.frequency, block)[1]
            for values in (record.angle, drive_torque(axis, record))
        )
        unit = np.exp(-1j * np.angle(theta))  # makes the angle real: rows are then in phase and in quadrature
        row = np.stack([np.abs(theta), 1j * w * np.abs(theta), -torque * unit], axis=1)
        rows += [row.real, row.imag]
        amplitudes.append(float(np.abs(theta).mean()))
        extra += [amplitudes[-1] ** 2 * part[:, :2] for part in (row.real, row.imag)]
        targets += [w**2 * np.abs(theta), np.zeros(theta.size)]
    columns, target = np.concatenate(rows), np.concatenate(targets)
    ratios, covariance = fit_linear(columns, target)
    check_driven_signs(axis.name, ratios)
    one_amplitude = np.ptp(amplitudes) < MAX_AMPLITUDE_CHANGE * max(amplitudes)
    if one_amplitude or len(frequencies) < 3 or not torque_is_linear(axis):  # five unknowns need three frequencies
        return values_from_ratios(ratios, covariance)
    change = difference_by_extra_columns(columns, np.concatenate(extra), target - columns @ ratios)
    return values_from_ratios(ratios, covariance, change.excess, float(change.conflict.max()))


def check_driven_signs(name: str, ratios: Array) -> None:
    """Check that a driven motion follows its torque and loses energy.

    Args:
        name: of the axis.
        ratios: k/J [1/s2], b/J [1/s] and 1/J [1/(kg m2)].

    Raises:
        BadInput: 1/J or b/J is not above 0.
    """
    if not ratios[2] > 0.0:
        hint = f"the sign of angle_{name}, drive_{name} or of a constant of the torque is reversed: state gain = -1"
        raise BadInput("moves against the torque of its drive", channel=f"angle_{name}", hint=hint)
    if not ratios[1] > 0.0:
        what = f"gains energy while it is driven: b/J is {ratios[1]:.3g} 1/s"
        hint = (
            f"it is early against drive_{name}, as by a delay of one of them or times that fall; else record for longer"
        )
        raise BadInput(what, channel=f"angle_{name}", hint=hint)


def values_from_ratios(
    ratios: Array, covariance: Array, excess: Array | None = None, conflict: float = 0.0
) -> dict[str, IdentifiedValue]:
    """``J``, ``b``, ``k``, ``k_over_J`` and ``b_over_J`` from (k/J, b/J, 1/J) and their covariance.

    Args:
        excess: difference of the ratios from an estimate that should agree, by which the intervals are widened, shape
            (3,). conflict: the largest such difference in standard deviations.
    """
    inverse = ratios[2]
    excess = np.zeros(3) if excess is None else excess
    values = _values(ratios)
    other = _values(ratios + excess) if inverse + excess[2] > 0.0 else {}  # else J has no second value: to first order
    jacobian = {
        "J": np.array([0.0, 0.0, -1.0 / inverse**2]),
        "b": np.array([0.0, 1.0 / inverse, -ratios[1] / inverse**2]),
        "k": np.array([1.0 / inverse, 0.0, -ratios[0] / inverse**2]),
        "k_over_J": np.array([1.0, 0.0, 0.0]),
        "b_over_J": np.array([0.0, 1.0, 0.0]),
    }
    found = {}
    for key, slope in jacobian.items():
        change = other[key] - values[key] if other else slope @ excess
        sd = float(np.hypot(np.sqrt(slope @ covariance @ slope), change))
        found[key] = IdentifiedValue(values[key], sd, conflict)
    return found


def _values(ratios: Array) -> dict[str, float]:
    """``J``, ``b``, ``k`` and the two ratios from (k/J, b/J, 1/J)."""
    stiffness, loss, inverse = (float(each) for each in ratios)
    return {"J": 1.0 / inverse, "b": loss / inverse, "k": stiffness / inverse, "k_over_J": stiffness, "b_over_J": loss}


def fit_ringdown(angle: Array, rate: float, axis: Axis, bias: float = 0.0) -> tuple[dict[str, IdentifiedValue], Array]:
    """``k_over_J`` [1/s2], ``b_over_J`` [1/s] and, under a bias, ``J`` from a free decay, by fitting its trajectory.

    J is left out where the 95 % interval of 1/J contains zero: then the bias changes the decay too little. Without a
    bias the offset of the angle is fitted too; a bias acts on the angle itself.

    Args:
        angle: shape (n,) [rad]. rate: [Hz].
        axis: start of the fit, and the capacitance on which a bias acts.
        bias: voltage on the combs [V]. It stiffens small amplitudes more than large ones, in proportion to 1/J: the
            only information of a ringdown about J.

    Returns:
        the values, and the residual of the fit, shape (n,) [rad].

    Raises:
        BadInput: there is no ringdown near the resonance, or the fit does not reproduce it.
    """
    from scipy.optimize import least_squares

    mechanics = axis.require_mechanics()
    comb = axis.require_capacitance() if bias else None
    stride = max(1, round(rate / (mechanics.resonance * STEPS_PER_CYCLE)))  # samples per step
    steps_a_stride = max(1, round(mechanics.resonance * STEPS_PER_CYCLE / rate))
    used = angle[::stride]
    step = stride / rate / steps_a_stride
    n = (used.size - 1) * steps_a_stride
    voltage, time = np.full((n, 3), bias), np.arange(used.size) * stride / rate
    w0, loss0 = _first_guess(used, rate / stride, mechanics)
    size = 0.01 * np.abs(used).max()
    scale = np.array([1e-3 * w0, 0.1 * loss0, size, w0 * size, 0.1 if comb else size])

    def trajectory(x: Array) -> Array:
        w, loss, theta, omega, last = start + scale * x
        if comb is None:
            return free_decay(time, w, min(max(loss, 1e-6 * loss0), w), theta, omega) + last
        J = mechanics.J / last
        tried = Axis(Mechanics(J, max(loss, 1e-6 * loss0) * J, w * w * J), comb)  # a step of the fit may overshoot
        return integrate(tried, (theta, omega), voltage, step)[0][::steps_a_stride]

    around = np.arange(min(used.size, 2 * STEPS_PER_CYCLE))
    line = np.polynomial.polynomial.polyfit(around[:9] * stride / rate, used[:9], 3)
    centre = 0.0 if comb else float(used.mean())
    start = np.array([w0, loss0, line[0] - centre, line[1], 1.0 if comb else centre])  # the last: 1/J, or the offset
    free = start.size
    x, lowest = np.zeros(free), np.full(free, -np.inf)
    if comb:
        lowest[4] = (MIN_INVERSE_INERTIA - start[4]) / scale[4]
    for part in (used.size // 8, used.size // 3, used.size):  # growing windows keep the phase error below half a cycle
        if part > 4 * free:
            fit = least_squares(lambda x, part=part: trajectory(x)[:part] - used[:part], x, bounds=(lowest, np.inf))
            x = fit.x
    residual = used - trajectory(x)
    if residual.std() > MAX_RINGDOWN_RESIDUAL_RATIO * used.std() and shows_motion(residual):
        raise BadInput(
            "the free decay does not follow the linear equation of motion",
            hint="cut the record to the decay alone; `lissajous diagnose` finds other laws",
        )
    variance = float(residual @ residual) / (used.size - free)
    covariance = np.linalg.inv(fit.jac.T @ fit.jac) * variance
    sd = scale * np.sqrt(np.diag(covariance))
    w, loss = start[:2] + scale[:2] * x[:2]
    change = _amplitude_dependence(fit.jac / scale, residual, time, (w, loss), start[2:4] + scale[2:4] * x[2:4])
    names, chosen, factors = ["k_over_J", "b_over_J"], [0, 1], [2.0 * float(w), 1.0]
    found = [IdentifiedValue(float(w * w), float(2 * w * sd[0])), IdentifiedValue(float(loss), float(sd[1]))]
    inverse = float(start[4] + scale[4] * x[4])
    if comb and inverse > Z_95 * sd[4]:
        J = mechanics.J / inverse
        names, chosen, factors = [*names, "J"], [*chosen, 4], [*factors, J / inverse]
        found.append(IdentifiedValue(J, factors[-1] * float(sd[4])))
    values = dict(zip(names, widen(found, change.select(chosen, factors)), strict=True))
    return values, residual


def _amplitude_dependence(
    columns: Array, residual: Array, time: Array, rates: tuple[float, float], state: Array
) -> Differences:
    """Changes of the parameters of a decay if its frequency and damping may depend on the amplitude, shape (p,).

    Args:
        columns: derivatives of the angle by square root of k/J, b/J, angle and velocity at the start, and any further
            parameters, shape (n, p).
        residual: of the fit [rad], time: [s], both of shape (n,).
        rates: square root of k/J [rad/s], and b/J [1/s].
        state: angle [rad] and velocity [rad/s] at the start, shape (2,).
    """
    (w, loss), (theta, omega) = rates, state
    by_theta, by_omega = columns[:, 2], columns[:, 3]
    by_phase = omega / w * by_theta - w * theta * by_omega
    extra = amplitude_columns(time, loss, by_phase, theta * by_theta + omega * by_omega)
    return difference_by_extra_columns(columns, extra, residual)


def free_decay(time: Array, w: float, loss: float, theta: float, omega: float) -> Array:
    """Angle of a free decay under a linear law, shape (n,) [rad].

    Args:
        time: shape (n,) [s]. w: square root of k/J [rad/s]. loss: b/J [1/s], less than 2 w.
        theta, omega: angle [rad] and velocity [rad/s] at the time 0.
    """
    turn = np.sqrt(w**2 - 0.25 * loss**2)
    phasor = theta - 1j * (omega + 0.5 * loss * theta) / turn
    return np.asarray((phasor * np.exp((1j * turn - 0.5 * loss) * time)).real)


def _first_guess(angle: Array, rate: float, mechanics: Mechanics) -> tuple[float, float]:
    """Angular frequency [rad/s] and b/J [1/s] of a decay, from the phasors of its blocks."""
    f = mechanics.resonance
    block = block_length(f, rate, 6.0)
    if angle.size < 4 * block:
        raise BadInput("the free decay is shorter than 24 cycles", hint="record for longer")
    time, z = block_phasors(angle, rate, 0.0, f, block)
    z = z * np.exp(-2j * np.pi * f * time)
    keep = np.abs(z) > 0.05 * np.abs(z).max()
    keep[np.argmin(keep) if not keep.all() else keep.size :] = False
    if keep.sum() < 3:
        raise BadInput("shows no free decay near the device's resonance", hint="check the device's k and J")
    slope = np.polyfit(time[keep], np.unwrap(np.angle(z[keep])), 1)[0]
    decay = np.polyfit(time[keep], np.log(np.abs(z[keep])), 1)[0]
    return 2 * np.pi * f + float(slope), max(-2.0 * float(decay), 1e-3)
