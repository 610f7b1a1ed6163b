"""From calibration recordings to the numbers of a device (chen2020 IV-A, chen2019 IV-B), each with its uncertainty.

A ringdown fixes k/J and b/J and no more: J, k and b scaled alike ring down alike. What sets the torque's scale, J,
comes from driven motion, where inertia stands against a torque ½ C'(θ) V² whose size is known.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanner.demodulate import block_length, block_phasors
from scanner.device import Amdm, Axis, Capacitance, Mechanics, Position, Transimpedance
from scanner.errors import BadInput
from scanner.laws import capacitance, capacitance_slope, electrostatic_torque
from scanner.lowpass import lowpass, step_coefficients
from scanner.trajectory import integrate

Array = NDArray[np.float64]

CYCLES = 20.0  # of the motion, a block of a driven record
STEPS_A_CYCLE = 80  # of Runge-Kutta in a ringdown's fit: its frequency is then right to 3e-7


@dataclass(frozen=True)
class Value:
    """An identified number and its standard deviation."""

    value: float
    sd: float

    @property
    def ci95(self) -> tuple[float, float]:
        """Interval that holds the truth 95 times in 100."""
        return self.value - 1.96 * self.sd, self.value + 1.96 * self.sd


def linear_fit(basis: Array, target: Array) -> tuple[Array, Array]:
    """Least squares with columns scaled to one size, so that farads and volts may stand side by side.

    Args:
        basis: shape (n, p). target: shape (n,).

    Returns:
        Coefficients, shape (p,), and their covariance for white residuals, shape (p, p).
    """
    size = np.sqrt(np.einsum("ni,ni->i", basis, basis))
    scaled = basis / size
    # einsum, not @: on tall thin matrices the threads of a BLAS cost fifty times what the sums do
    gram = np.linalg.inv(np.einsum("ni,nj->ij", scaled, scaled))
    fitted = gram @ np.einsum("ni,n->i", scaled, target)
    residual = target - np.einsum("ni,i->n", scaled, fitted)
    covariance = gram * np.einsum("n,n->", residual, residual) / (target.size - fitted.size)
    return fitted / size, covariance / np.outer(size, size)


@dataclass(frozen=True)
class Driven:
    """One stretch of driven motion at one drive frequency.

    Attributes:
        angle: shape (n,) [rad]. voltage: on the combs at the same samples [V].
        frequency: of the motion [Hz]. rate: of the samples [Hz].
    """

    angle: Array
    voltage: Array
    frequency: float
    rate: float


def drive_torque(axis: Axis, record: Driven) -> Array:
    """Torque of the drive at the samples of a record, shape (n,) [N m]."""
    drive = axis.require_drive()
    if drive.kind == "linear":
        return (drive.torque_per_volt or 0.0) * record.voltage
    comb = axis.require_capacitance()
    return electrostatic_torque(capacitance_slope(record.angle, comb.C0, comb.theta0, comb.theta_th), record.voltage)


def mechanics_from_driven(axis: Axis, records: Sequence[Driven]) -> dict[str, Value]:
    """``J``, ``b`` and ``k`` from driven motion: the equation of motion (chen2020 eq 9), at the motion's frequency.

    A block's phasors of angle and torque obey (k/J - w^2 + j w b/J) Θ = T / J, linear in k/J, b/J and 1/J. Phase and
    amplitude at one drive frequency give two equations, so two frequencies are needed.

    Args:
        axis: its drive and its capacitance set the torque; its mechanics are not used.
        records: steady motion.

    Raises:
        BadInput: one frequency only.
    """
    if len({round(record.frequency, 3) for record in records}) < 2:
        raise BadInput("driven records at two or more drive frequencies are needed to tell k, b and J", hint="sweep")
    rows, targets = [], []
    for record in records:
        w = 2 * np.pi * record.frequency
        block = block_length(record.frequency, record.rate, CYCLES)
        turn, torque = (
            block_phasors(values, record.rate, 0.0, record.frequency, block)[1]
            for values in (record.angle, drive_torque(axis, record))
        )
        unit = np.exp(-1j * np.angle(turn))  # every block's angle made real: rows are then in phase and in quadrature
        row = np.stack([np.abs(turn), 1j * w * np.abs(turn), -torque * unit], axis=1)
        rows += [row.real, row.imag]
        targets += [w**2 * np.abs(turn), np.zeros(turn.size)]
    (stiff, loss, inverse), covariance = linear_fit(np.concatenate(rows), np.concatenate(targets))
    jacobian = {
        "J": np.array([0.0, 0.0, -1.0 / inverse**2]),
        "b": np.array([0.0, 1.0 / inverse, -loss / inverse**2]),
        "k": np.array([1.0 / inverse, 0.0, -stiff / inverse**2]),
    }
    values = {"J": 1.0 / inverse, "b": loss / inverse, "k": stiff / inverse}
    return {key: Value(float(values[key]), float(np.sqrt(g @ covariance @ g))) for key, g in jacobian.items()}


def ringdown(angle: Array, rate: float, axis: Axis, bias: float = 0.0) -> tuple[dict[str, Value], Array]:
    """``k_over_J`` [1/s2], ``b_over_J`` [1/s] and, under a bias, ``J`` from a free decay, by fitting its trajectory.

    Args:
        angle: shape (n,) [rad]. rate: [Hz].
        axis: where the fit starts, and the capacitance that a bias pulls at.
        bias: voltage on the combs [V]. It stiffens small swings more than large ones by an amount that goes as 1/J,
            which is all that a ringdown can tell of J.

    Returns:
        the values, and the residual of the fit, shape (n,) [rad].

    Raises:
        BadInput: nothing rings, or the fit does not follow it.
    """
    from scipy.optimize import least_squares

    mechanics = axis.require_mechanics()
    comb = axis.require_capacitance() if bias else None
    stride = max(1, round(rate / (mechanics.resonance * STEPS_A_CYCLE)))  # samples a step: few are enough
    steps_a_stride = max(1, round(mechanics.resonance * STEPS_A_CYCLE / rate))
    used = angle[::stride]
    step = stride / rate / steps_a_stride
    n = (used.size - 1) * steps_a_stride
    voltage = np.full((n, 3), bias)
    w0, loss0 = _first_guess(used, rate / stride, mechanics)
    scale = np.array([1e-3 * w0, 0.1 * loss0, 0.01 * np.abs(used).max(), 0.01 * w0 * np.abs(used).max(), 0.1])

    def trajectory(x: Array) -> Array:
        w, loss, theta, omega, log_inverse = start + scale * np.append(x, np.zeros(5 - x.size))
        J = mechanics.J * np.exp(-log_inverse)
        tried = Axis(Mechanics(J, max(loss, 1e-6 * loss0) * J, w * w * J), comb)  # a step of the fit may overshoot
        return integrate(tried, (theta, omega), voltage, step)[0][::steps_a_stride]

    around = np.arange(min(used.size, 2 * STEPS_A_CYCLE))
    line = np.polynomial.polynomial.polyfit(around[:9] * stride / rate, used[:9], 3)
    start = np.array([w0, loss0, line[0], line[1], 0.0])
    free = 5 if comb else 4
    x = np.zeros(free)
    for part in (used.size // 8, used.size // 3, used.size):  # a window that grows keeps the phase within reach
        if part > 4 * free:
            fit = least_squares(lambda x, part=part: trajectory(x)[:part] - used[:part], x, x_scale=1.0, method="trf")
            x = fit.x
    residual = used - trajectory(x)
    if residual.std() > 0.3 * used.std():
        raise BadInput(
            "the free decay does not follow the equation of motion", hint="cut the record to the decay alone"
        )
    variance = float(residual @ residual) / (used.size - free)
    covariance = np.linalg.inv(fit.jac.T @ fit.jac) * variance
    sd = scale[:free] * np.sqrt(np.diag(covariance))
    w, loss = start[:2] + scale[:2] * x[:2]
    values = {"k_over_J": Value(float(w * w), float(2 * w * sd[0])), "b_over_J": Value(float(loss), float(sd[1]))}
    if comb:
        J = mechanics.J * np.exp(-scale[4] * x[4])
        values["J"] = Value(float(J), float(J * sd[4]))
    return values, residual


def _first_guess(angle: Array, rate: float, mechanics: Mechanics) -> tuple[float, float]:
    """Angular frequency and b/J of a decay from the phasors of its blocks."""
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


@dataclass(frozen=True)
class ReadoutFit:
    """An AMDM readout against a reference angle.

    Attributes:
        values: ``a_cir`` [V/F], ``b_cir`` [V], ``delay`` [s] beyond the sections, ``square`` [V/F^2] of the squared
            capacitance, ``feed`` [1] and ``feed_rate`` [s] of the drive that leaks through.
        coefficients: of all ``readout_features``, 0 for a term left out, shape (6,).
        noise_sd: of the residual [V].
    """

    values: Mapping[str, Value]
    coefficients: Array
    noise_sd: float


def readout_features(comb: Capacitance, angle: Array, voltage: Array, rate: float, sections: Sequence[float]) -> Array:
    """What an AMDM output is a sum of: C, 1, C', C^2 behind the sections, the drive and its rate; shape (n, 6)."""
    C = capacitance(angle, comb.C0, comb.Cb, comb.theta0, comb.theta_th)
    square = C * C
    for cutoff in sections:
        coefficients = step_coefficients(cutoff, 1.0 / rate)
        lowpass(C, *coefficients, C[0], C[0])
        lowpass(square, *coefficients, square[0], square[0])
    one = np.ones_like(C)
    swing = voltage - voltage.mean()
    return np.stack([C, one, np.gradient(C, 1 / rate), square, swing, np.gradient(voltage, 1 / rate)], axis=1)


FEATURES = ("a_cir", "b_cir", "delay", "square", "feed", "feed_rate")


def readout_from_driven(
    comb: Capacitance,
    records: Sequence[Driven],
    senses: Sequence[Array],
    sections: Sequence[float],
    terms: Sequence[str] = FEATURES,
    skip: float = 1e-4,
) -> ReadoutFit:
    """Gain and offset of an AMDM readout, and what the formula a_cir C + b_cir leaves out, by least squares.

    Args:
        records: with the reference angle. senses: the output at the same samples [V].
        sections: corner of every low-pass section [Hz].
        terms: which of ``FEATURES``; the paper's own fit is ``("a_cir", "b_cir")`` and no sections.
        skip: that the sections need to settle [s].
    """
    columns = [FEATURES.index(term) for term in terms]
    basis, target = [], []
    for record, sense in zip(records, senses, strict=True):
        first = round(skip * record.rate)
        features = readout_features(comb, record.angle, record.voltage, record.rate, sections)
        basis.append(features[first:, columns])
        target.append(sense[first:])
    stacked, y = np.concatenate(basis), np.concatenate(target)
    fitted, covariance = linear_fit(stacked, y)
    values = {term: Value(float(fitted[i]), float(np.sqrt(covariance[i, i]))) for i, term in enumerate(terms)}
    coefficients = np.zeros(len(FEATURES))
    coefficients[columns] = fitted
    if "delay" in values:  # C(t - delay) = C - delay C'
        slope, a_cir = values["delay"], values["a_cir"].value
        values["delay"] = Value(-slope.value / a_cir, slope.sd / abs(a_cir))
    return ReadoutFit(values, coefficients, float(np.std(y - stacked @ fitted)))


@dataclass(frozen=True)
class Profile:
    """The capacitance's bell from a sense signal and a reference angle (chen2020 fig 7b, chen2019 fig 4b).

    Attributes:
        values: ``theta0``, ``theta_th`` [rad], ``delay`` of the sense signal against the angle [s]; ``C0`` [F] behind a
            transimpedance readout, ``a_cir`` [V/F] and ``b_cir`` [V] behind an AMDM one, which sees C0 only times
            a_cir.
        residual_sd: of the fit [V].
    """

    values: Mapping[str, Value]
    residual_sd: float


def profile(axis: Axis, angle: Array, sense: Array, rate: float, frequency: float) -> Profile:
    """Fit the bell, the readout's linear constants and the delay between the two channels.

    The angle is smoothed over a twelfth of a cycle first; its noise would otherwise flatten the bell.

    Args:
        axis: nominal, with an AMDM or a transimpedance readout. angle: [rad], sense: [V], at the same samples, shape
        (n,). rate: [Hz]. frequency: of the motion [Hz].

    Raises:
        BadInput: a position readout, which has no bell.
    """
    from scipy.optimize import least_squares
    from scipy.signal import savgol_filter

    comb, readout = axis.require_capacitance(), axis.require_readout()
    if isinstance(readout, Position):
        raise BadInput("a position readout does not see the capacitance", channel=f"sense_{axis.name}")
    window = max(7, 2 * round(rate / frequency / 24) + 1)
    theta = savgol_filter(angle, window, min(4, window - 2))
    omega = savgol_filter(angle, window, min(4, window - 2), deriv=1, delta=1 / rate)
    quarter = round(0.25 * rate / frequency)
    edge = slice(window + quarter + round(1e-4 * rate), -window - quarter)
    sections = readout.lpf_hz if isinstance(readout, Amdm) else ()
    samples = np.arange(theta.size)
    y = sense[edge]

    def fitted(x: Array) -> tuple[Array, Array, Array]:
        theta0, theta_th, late = x * scale
        at = samples - late * rate
        u = (np.interp(at, samples, theta) - theta_th) / theta0
        bell = np.exp(-u * u)
        if isinstance(readout, Transimpedance):
            slope = -2.0 * u / theta0 * bell * np.interp(at, samples, omega)
            basis = -readout.R_s * readout.V_bias * slope[edge, None]
        else:
            for cutoff in sections:
                lowpass(bell, *step_coefficients(cutoff, 1 / rate), bell[0], bell[0])
            basis = np.stack([bell, np.ones_like(bell)], axis=1)[edge]
        linear, covariance = linear_fit(basis, y)
        return np.einsum("ni,i->n", basis, linear) - y, linear, covariance

    scale = np.array([comb.theta0, comb.theta0, 0.01 / frequency])
    delays = (
        np.arange(-quarter, quarter + 1, max(1, quarter // 12)) / rate
    )  # a wrong half cycle would be a local minimum
    starts = [np.array([1.0, comb.theta_th / comb.theta0, late / scale[2]]) for late in delays]
    start = min(starts, key=lambda x: float(np.square(fitted(x)[0]).sum()))
    solution = least_squares(lambda x: fitted(x)[0], start, diff_step=1e-5, ftol=1e-10)
    residual, linear, covariance = fitted(solution.x)
    # The linear constants are eliminated inside the residual: its Jacobian is the one of the nonlinear three
    # alone, and a linear constant's spread is its own plus what the three pass on.
    variance = float(residual @ residual) / (residual.size - 3 - linear.size)
    spread = np.linalg.inv(solution.jac.T @ solution.jac) * variance
    step = 1e-4
    passed = np.column_stack(
        [(fitted(solution.x + step * e)[1] - fitted(solution.x - step * e)[1]) / (2 * step) for e in np.eye(3)]
    )
    sd = scale * np.sqrt(np.diag(spread))
    total = covariance + passed @ spread @ passed.T
    linear_sd = np.sqrt(np.diag(total))
    found = solution.x * scale
    values = {
        key: Value(float(v), float(d)) for key, v, d in zip(("theta0", "theta_th", "delay"), found, sd, strict=True)
    }
    if isinstance(readout, Transimpedance):
        values["C0"] = Value(float(linear[0]), float(linear_sd[0]))
    else:  # y = a_cir (C0 bell + Cb) + b_cir
        values["a_cir"] = Value(float(linear[0]) / comb.C0, float(linear_sd[0]) / comb.C0)
        weight = np.array([-comb.Cb / comb.C0, 1.0])
        values["b_cir"] = Value(float(weight @ linear), float(np.sqrt(weight @ total @ weight)))
    return Profile(values, float(np.sqrt(variance)))
