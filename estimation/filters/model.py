"""The filters' model of axes and readout: one definition for the readable and the compiled engine.

Process: half of the drive's impulse, the exact damped free motion over a sample, the other half (Strang splitting). The
Euler step printed in chen2020 eq 10 adds energy at a rate omega^2 Ts / 2, which is more than the mirror loses; this
step conserves energy to (omega Ts)^2 times the torque.

Measurement: the readout's law. The low-pass sections of an AMDM readout are states, so that their delay is right at any
frequency of the motion.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from estimation.filters.fast_capacitance import gaussian_capacitance
from scanner.arrays import Array
from scanner.device import Axis, Device
from scanner.errors import DeviceInvalid
from scanner.laws import electrostatic_torque
from scanner.lowpass import section_coefficients
from scanner.stages import Acceleration, Amdm, Capacitance, MotionSensor, Position, Readout, Velocity

AXIS_PARAMETERS = (
    "m11", "m12", "m21", "m22", "half_step_over_J", "electrostatic", "torque_per_volt", "C0", "Cb", "inverse_theta0",
    "theta_th",
)  # fmt: skip
"""Parameters of one axis, in the order in which ``axis_capacitance`` and ``axis_step`` take them: the free motion over
a sample, exp([[0, 1], [-k/J, -b/J]] Ts); Ts / (2 J) [s / (kg m2)]; 1 for an electrostatic drive, 0 for a linear one;
torque per volt of a linear drive [N m/V]; the capacitance [F, F, 1/rad, rad]."""

MOTION_ORDER = {Position.kind: Position.order, Velocity.kind: Velocity.order}
"""Which of an axis's states (theta, omega) a sensor of the motion measures, by the kind of the readout."""

SECTION_ERROR_RATIO = 1e-6
"""Standard deviation of a low-pass section's error in one sample, relative to C0: its input is taken as linear between
samples. Without it the sections are known except for rounding, and the covariance becomes singular."""


@njit(cache=True, error_model="numpy", forceinline=True)
def axis_capacitance(  # type: ignore[no-untyped-def]
    theta, m11, m12, m21, m22, half_step_over_J, electrostatic, torque_per_volt, C0, Cb, inverse_theta0, theta_th
):
    """Capacitance [F] and its first two derivatives [F/rad, F/rad2] at ``theta``, from all ``AXIS_PARAMETERS``."""
    return gaussian_capacitance(theta, C0, Cb, inverse_theta0, theta_th)


@njit(cache=True, error_model="numpy", fastmath={"contract"}, forceinline=True)
def axis_step(  # type: ignore[no-untyped-def]
    theta, omega, capacitance, v0, v1,
    m11, m12, m21, m22, half_step_over_J, electrostatic, torque_per_volt, C0, Cb, inverse_theta0, theta_th,
):  # fmt: skip
    """One sample of the process model.

    Args:
        theta, omega: state at the start [rad, rad/s].
        capacitance: ``axis_capacitance`` at theta.
        v0, v1: drive voltage at the start and the end of the step [V].
        m11 ... theta_th: ``AXIS_PARAMETERS``.

    Returns:
        (theta, omega) at the end; their derivatives (d theta/d theta0, d theta/d omega0, d omega/d theta0,
        d omega/d omega0) on the state at the start; ``axis_capacitance`` at the new theta.
    """
    _, slope, curvature = capacitance
    impulse_per_slope = electrostatic_torque(half_step_over_J * electrostatic, v0)  # d omega / d C'
    impulse_gradient = impulse_per_slope * curvature
    omega_half = omega + half_step_over_J * torque_per_volt * v0
    # the slope is added last: it is the quantity that is waited for
    theta_new = (m11 * theta + m12 * omega_half) + (m12 * impulse_per_slope) * slope
    omega_new = (m21 * theta + m22 * omega_half) + (m22 * impulse_per_slope) * slope
    a11, a21 = m11 + m12 * impulse_gradient, m21 + m22 * impulse_gradient
    capacitance_new = gaussian_capacitance(theta_new, C0, Cb, inverse_theta0, theta_th)
    _, slope, curvature = capacitance_new
    impulse_per_slope = electrostatic_torque(half_step_over_J * electrostatic, v1)
    impulse_gradient = impulse_per_slope * curvature
    omega_new = (omega_new + half_step_over_J * torque_per_volt * v1) + impulse_per_slope * slope
    jacobian = (a11, m12, a21 + impulse_gradient * a11, m22 + impulse_gradient * m12)
    return (theta_new, omega_new), jacobian, capacitance_new


@dataclass(frozen=True)
class FilterModel:
    """The model of a filter as arrays.

    The state is (theta, omega) of each axis in ``axes``, then the output of each low-pass section in units of
    capacitance [F].

    Attributes:
        axes: names, in the order of the state.
        kind: of the readout: ``"amdm"``, ``"transimpedance"``, ``"position"`` or ``"velocity"``.
        step: sampling interval [s].
        parameters: ``AXIS_PARAMETERS`` of each axis, shape (axes, 11).
        sections: (e, p, q) of each low-pass section, shape (sections, 3).
        gain, offset: of the readout: a_cir [V/F] and b_cir [V]; -R_s V_bias [ohm V] and 0; or gain [V/rad, V s/rad]
            and offset [V].
        noise_var: of the measurement [V^2].
        section_noise: variance that each section gains a step [F^2], see ``SECTION_ERROR_RATIO``.
    """

    axes: tuple[str, ...]
    kind: str
    step: float
    parameters: Array
    sections: Array
    gain: float
    offset: float
    noise_var: float
    section_noise: float

    @property
    def states(self) -> int:
        """Dimension of the state."""
        return 2 * len(self.axes) + len(self.sections)


def filter_model(
    device: Device, axes: tuple[str, ...], readout: Readout, step: float, offset: float | None = None
) -> FilterModel:
    """The model of ``axes`` with one ``readout``, sampled every ``step`` seconds.

    Args:
        step: sampling interval [s].
        offset: of the readout [V] as measured; the device's without it.

    Raises:
        DeviceInvalid: a needed value is missing, or a readout for one axis was given several.
    """
    if not isinstance(readout, Amdm) and len(axes) > 1:
        raise DeviceInvalid(
            f"a {readout.kind} readout is followed for one axis at a time", file=device.source, channel="readout"
        )
    match readout:
        case Amdm():
            sections = np.array([section_coefficients(cutoff, step) for cutoff in readout.lpf_hz]).reshape(-1, 3)
            gain, nominal_offset = readout.a_cir, readout.b_cir
        case Acceleration():
            hint = "choose the tracker"
            what = "an acceleration readout is not a function of the filter's state"
            raise DeviceInvalid(what, file=device.source, channel="readout", hint=hint)
        case MotionSensor():
            sections, gain, nominal_offset = np.empty((0, 3)), readout.gain, readout.offset
        case _:
            sections, gain, nominal_offset = np.empty((0, 3)), -readout.R_s * readout.V_bias, 0.0
    return FilterModel(
        axes=axes,
        kind=readout.kind,
        step=step,
        parameters=np.array([axis_parameters(device.axis(name), step, readout) for name in axes]),
        sections=sections,
        gain=gain,
        offset=nominal_offset if offset is None else offset,
        noise_var=readout.noise_sd**2,
        section_noise=max(((SECTION_ERROR_RATIO * comb.C0) ** 2 for comb in _combs(device, axes)), default=0.0),
    )


def _combs(device: Device, axes: tuple[str, ...]) -> list[Capacitance]:
    return [comb for name in axes if (comb := device.axis(name).capacitance) is not None]


def axis_parameters(axis: Axis, step: float, readout: Readout) -> list[float]:
    """``AXIS_PARAMETERS`` of one axis."""
    from scipy.linalg import expm

    mechanics, drive = axis.require_mechanics(), axis.require_drive()
    free_motion = expm(np.array([[0.0, 1.0], [-mechanics.k / mechanics.J, -mechanics.b / mechanics.J]]) * step)
    if drive.kind == "electrostatic" or not isinstance(readout, MotionSensor):
        capacitance = axis.require_capacitance()
        shape = [capacitance.C0, capacitance.Cb, 1.0 / capacitance.theta0, capacitance.theta_th]
    else:
        shape = [0.0, 0.0, 1.0, 0.0]
    is_electrostatic = drive.kind == "electrostatic"
    actuation = [1.0, 0.0] if is_electrostatic else [0.0, drive.torque_per_volt or 0.0]
    return [*free_motion.ravel(), step / (2.0 * mechanics.J), *actuation, *shape]
