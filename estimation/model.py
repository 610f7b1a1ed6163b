"""The filters' model of an axis and its readout: one definition for the readable engine and the compiled one.

Process: half a kick by the drive's torque, the exact damped free flow over a sample, half a kick (Strang's splitting).
A first-order (Euler) step, as printed in chen2020 eq 10, feeds energy into the motion at a rate omega^2 Ts / 2, more
than the mirror loses; this one conserves it to (omega Ts)^2 times the small torque.

Measurement: the readout's law; an AMDM readout's low-pass sections are carried as states, so that their delay is right
at whatever frequency the motion has at the moment.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from estimation.bell import bell
from scanner.device import Amdm, Axis, Capacitance, Device, Position, Readout
from scanner.errors import DeviceInvalid
from scanner.laws import electrostatic_torque
from scanner.lowpass import step_coefficients

Array = NDArray[np.float64]

AXIS_PARAMETERS = ("m11", "m12", "m21", "m22", "kick", "pull", "push", "C0", "Cb", "narrow", "theta_th")


@njit(cache=True, error_model="numpy", forceinline=True)
def comb(theta, m11, m12, m21, m22, kick, pull, push, C0, Cb, narrow, theta_th):  # type: ignore[no-untyped-def]
    """Capacitance [F] and its first two derivatives at ``theta``; takes an axis's parameters whole."""
    return bell(theta, C0, Cb, narrow, theta_th)


@njit(cache=True, error_model="numpy", fastmath={"contract"}, forceinline=True)
def axis_step(theta, omega, old, v0, v1, m11, m12, m21, m22, kick, pull, push, C0, Cb, narrow, theta_th):  # type: ignore[no-untyped-def]
    """One sample of the process model.

    Args:
        theta, omega: state [rad, rad/s].
        old: ``comb`` at theta.
        v0, v1: drive voltage at the start and the end of the step [V].
        m11 ... m22: the free flow, exp([[0, 1], [-k/J, -b/J]] Ts).
        kick: Ts / (2 J).
        pull: 1 for an electrostatic drive, 0 for a linear one.
        push: torque per volt of a linear drive [N m/V], 0 for an electrostatic one.

    Returns:
        (theta, omega), (d theta/d theta0, d theta/d omega0, d omega/d theta0, d omega/d omega0) and the new ``comb``.
    """
    _, slope, curvature = old
    pulled = electrostatic_torque(kick * pull, v0)  # gain of rate by slope
    bend = pulled * curvature
    begun = omega + kick * push * v0
    angle = (m11 * theta + m12 * begun) + (m12 * pulled) * slope  # the slope last: it is what is waited for
    rate = (m21 * theta + m22 * begun) + (m22 * pulled) * slope
    a11, a21 = m11 + m12 * bend, m21 + m22 * bend
    new = bell(angle, C0, Cb, narrow, theta_th)
    _, slope, curvature = new
    pulled = electrostatic_torque(kick * pull, v1)
    bend = pulled * curvature
    rate = (rate + kick * push * v1) + pulled * slope
    return (angle, rate), (a11, m12, a21 + bend * a11, m22 + bend * m12), new


@dataclass(frozen=True)
class FilterModel:
    """A filter's model in numbers.

    The state is (theta, omega) of each axis in ``axes``, then the output of each low-pass section in units of
    capacitance [F].

    Attributes:
        axes: names, in the order of the state.
        kind: of the readout: ``"amdm"``, ``"transimpedance"`` or ``"position"``.
        step: sampling interval [s].
        parameters: ``AXIS_PARAMETERS`` of each axis, shape (axes, 11).
        sections: (e, p, q) of each low-pass section, shape (sections, 3).
        gain, offset: of the readout: a_cir, b_cir; -R_s V_bias, 0; gain, offset.
        noise_var: of the measurement [V^2].
        section_noise: variance that each section gains a step [F^2]: the error of taking its input as linear between
            samples. Without it the sections are known but for rounding, which then makes the covariance singular.
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
    """The model of ``axes`` behind one ``readout``, sampled every ``step`` seconds.

    Args:
        offset: of the readout [V], where it was measured; the device's own otherwise.

    Raises:
        DeviceInvalid: a needed value is missing, or a readout for one axis was given several.
    """
    if not isinstance(readout, Amdm) and len(axes) > 1:
        raise DeviceInvalid(
            f"a {readout.kind} readout is followed for one axis at a time", file=device.source, channel="readout"
        )
    match readout:
        case Amdm():
            sections = np.array([step_coefficients(cutoff, step) for cutoff in readout.lpf_hz]).reshape(-1, 3)
            gain, own_offset = readout.a_cir, readout.b_cir
        case Position():
            sections, gain, own_offset = np.empty((0, 3)), readout.gain, readout.offset
        case _:
            sections, gain, own_offset = np.empty((0, 3)), -readout.R_s * readout.V_bias, 0.0
    return FilterModel(
        axes=axes,
        kind=readout.kind,
        step=step,
        parameters=np.array([axis_parameters(device.axis(name), step, readout) for name in axes]),
        sections=sections,
        gain=gain,
        offset=own_offset if offset is None else offset,
        noise_var=readout.noise_sd**2,
        section_noise=max(((1e-6 * own.C0) ** 2 for own in _combs(device, axes)), default=0.0),
    )


def _combs(device: Device, axes: tuple[str, ...]) -> list[Capacitance]:
    return [found for name in axes if (found := device.axis(name).capacitance) is not None]


def axis_parameters(axis: Axis, step: float, readout: Readout) -> list[float]:
    """``AXIS_PARAMETERS`` of one axis."""
    from scipy.linalg import expm

    mechanics, drive = axis.require_mechanics(), axis.require_drive()
    flow = expm(np.array([[0.0, 1.0], [-mechanics.k / mechanics.J, -mechanics.b / mechanics.J]]) * step)
    if drive.kind == "electrostatic" or not isinstance(readout, Position):
        capacitance = axis.require_capacitance()
        shape = [capacitance.C0, capacitance.Cb, 1.0 / capacitance.theta0, capacitance.theta_th]
    else:
        shape = [0.0, 0.0, 1.0, 0.0]
    pull, push = (1.0, 0.0) if drive.kind == "electrostatic" else (0.0, drive.torque_per_volt or 0.0)
    return [*flow.ravel(), step / (2.0 * mechanics.J), pull, push, *shape]
