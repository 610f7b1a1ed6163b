"""Capacitance and constants of its readout from angle and sense signal (chen2020 IV-A, chen2019 IV-B)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import ceil

import numpy as np

from estimation.identification.agreement import IdentifiedValue
from estimation.least_squares import fit_linear
from scanner.arrays import Array
from scanner.device import Axis
from scanner.errors import BadInput
from scanner.lowpass import apply_lowpass
from scanner.stages import Amdm, MotionSensor, Transimpedance

SECTION_SAMPLES_PER_CYCLE = 400
"""Samples a cycle at which low-pass sections are stepped: their input is taken as linear between samples."""

SMOOTHING_CYCLES, SMOOTHING_ORDER = 1 / 3, 6
"""Cycles and polynomial order of the smoothing of the angle behind a comb: the velocity of a sine is then right to
6e-5, and has a fifth of the noise that a twelfth of a cycle of fourth order passes at 80 samples a cycle."""


@dataclass(frozen=True)
class CapacitanceProfile:
    """The capacitance over the angle, from a sense signal and a reference angle (chen2020 fig 7b, chen2019 fig 4b).

    Attributes:
        values: ``theta0``, ``theta_th`` [rad], ``delay`` of the sense signal against the angle [s]; ``C0`` [F] behind a
            transimpedance readout, ``a_cir`` [V/F] and ``b_cir`` [V] of an AMDM one, whose signal depends on C0 only
            times a_cir.
        residual_sd: of the fit [V].
    """

    values: Mapping[str, IdentifiedValue]
    residual_sd: float


def fit_capacitance_profile(
    axis: Axis, angle: Array, sense: Array, rate: float, frequency: float
) -> CapacitanceProfile:
    """Fit the Gaussian capacitance, the readout's linear constants and the delay between the two channels.

    The angle is smoothed over a third of a cycle first, because its noise would flatten the fitted curve. What is left
    of its noise is correlated in the residual, which the covariance allows for by sums over whole cycles. Low-pass
    sections are stepped on a finer grid: at 40 samples a cycle theta0 was 1.1 % too large without it.

    Args:
        axis: nominal, with an AMDM or a transimpedance readout. angle: [rad], sense: [V], at the same samples, shape
        (n,). rate: [Hz]. frequency: of the motion [Hz].

    Raises:
        BadInput: a position readout, which does not measure the capacitance.
    """
    from scipy.interpolate import CubicSpline
    from scipy.optimize import least_squares
    from scipy.signal import savgol_filter

    comb, readout = axis.require_capacitance(), axis.require_readout()
    if isinstance(readout, MotionSensor):
        raise BadInput(f"a {readout.kind} readout does not measure the capacitance", channel=f"sense_{axis.name}")
    window = max(SMOOTHING_ORDER + 1, 2 * ceil(0.5 * SMOOTHING_CYCLES * rate / frequency) + 1)
    theta = savgol_filter(angle, window, SMOOTHING_ORDER)
    omega = savgol_filter(angle, window, SMOOTHING_ORDER, deriv=1, delta=1 / rate)
    quarter = round(0.25 * rate / frequency)
    edge = slice(window + quarter + round(1e-4 * rate), -window - quarter)
    sections = readout.lpf_hz if isinstance(readout, Amdm) else ()
    finer = max(1, round(SECTION_SAMPLES_PER_CYCLE * frequency / rate)) if sections else 1
    samples, at = np.arange(theta.size), np.arange((theta.size - 1) * finer + 1) / finer
    angle_at, velocity_at = CubicSpline(samples, theta), CubicSpline(samples, omega)
    y = sense[edge]

    def fitted(x: Array) -> tuple[Array, Array, Array]:
        theta0, theta_th, delay = x * scale
        shifted = np.clip(at - delay * rate, 0.0, theta.size - 1.0)
        u = (angle_at(shifted) - theta_th) / theta0
        shape = np.exp(-u * u)
        if isinstance(readout, Transimpedance):
            slope = -2.0 * u / theta0 * shape * velocity_at(shifted)
            basis = -readout.R_s * readout.V_bias * slope[edge, None]
        else:
            for cutoff in sections:
                shape = apply_lowpass(shape, cutoff, 1 / (rate * finer))
            basis = np.stack([shape[::finer], np.ones_like(theta)], axis=1)[edge]
        linear, _ = fit_linear(basis, y)
        return np.einsum("ni,i->n", basis, linear) - y, linear, basis

    scale = np.array([comb.theta0, comb.theta0, 0.01 / frequency])
    delays = (
        np.arange(-quarter, quarter + 1, max(1, quarter // 12)) / rate
    )  # a wrong half cycle would be a local minimum
    starts = [np.array([1.0, comb.theta_th / comb.theta0, delay / scale[2]]) for delay in delays]
    start = min(starts, key=lambda x: float(np.square(fitted(x)[0]).sum()))
    solution = least_squares(lambda x: fitted(x)[0], start, diff_step=1e-5, ftol=1e-10)
    residual, linear, basis = fitted(solution.x)
    step = 1e-4
    sensitivity = np.column_stack(
        [(fitted(solution.x + step * e)[1] - fitted(solution.x - step * e)[1]) / (2 * step) for e in np.eye(3)]
    )
    # The linear constants are eliminated inside the residual, whose Jacobian is that of the three nonlinear ones. A
    # linear constant changes with them by its sensitivity.
    covariance = covariance_by_blocks(np.hstack([solution.jac, basis]), residual, rate / frequency)
    change = np.block([[np.eye(3), np.zeros((3, linear.size))], [sensitivity, np.eye(linear.size)]])
    covariance = change @ covariance @ change.T
    sd, linear_sd = np.split(np.sqrt(np.diag(covariance)), [3])
    sd, total = scale * sd, covariance[3:, 3:]
    variance = float(residual @ residual) / (residual.size - 3 - linear.size)
    estimates = solution.x * scale
    values = {
        key: IdentifiedValue(float(v), float(d))
        for key, v, d in zip(("theta0", "theta_th", "delay"), estimates, sd, strict=True)
    }
    if isinstance(readout, Transimpedance):
        values["C0"] = IdentifiedValue(float(linear[0]), float(linear_sd[0]))
    else:  # y = a_cir (C0 shape + Cb) + b_cir
        values["a_cir"] = IdentifiedValue(float(linear[0]) / comb.C0, float(linear_sd[0]) / comb.C0)
        weight = np.array([-comb.Cb / comb.C0, 1.0])
        values["b_cir"] = IdentifiedValue(float(weight @ linear), float(np.sqrt(weight @ total @ weight)))
    return CapacitanceProfile(values, float(np.sqrt(variance)))


def covariance_by_blocks(columns: Array, residual: Array, block: float) -> Array:
    """Covariance of the coefficients of a linear fit whose residual is correlated within blocks, shape (p, p).

    The moments of the columns with the residual are summed over blocks, and their sums are taken as independent. With
    no more than 2 p blocks the residual is taken as white.

    Args:
        columns: shape (n, p). residual: shape (n,). block: samples, longer than the correlation.
    """
    size = np.sqrt(np.einsum("ni,ni->i", columns, columns))
    scaled = columns / size
    inverse = np.linalg.inv(np.einsum("ni,nj->ij", scaled, scaled))
    n, p = columns.shape
    starts = np.round(np.arange(0.0, n - 0.5 * block, block)).astype(int)
    if starts.size > 2 * p:
        sums = np.add.reduceat(scaled * residual[:, None], starts)
        moments = np.einsum("bi,bj->ij", sums, sums) * (starts.size / (starts.size - p))
    else:
        moments = np.einsum("ni,nj->ij", scaled, scaled) * (float(residual @ residual) / (n - p))
    return np.asarray(inverse @ moments @ inverse / np.outer(size, size))
