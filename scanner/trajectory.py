"""The equation of motion with any set of extra physics, integrated by one compiled kernel.

A mechanics term hands over its torque, a capacitance term its extra bell, as compiled functions that the kernel calls
through their addresses: a new term needs no new kernel, and one compilation serves all of them. Terms of the other
stages act on whole arrays before or after the integration and never come here.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numba import NumbaExperimentalFeatureWarning, njit, types
from numba.experimental.function_type import _get_wrapper_address
from numpy.typing import NDArray

from scanner.device import Axis
from scanner.laws import angular_acceleration, capacitance_slope, electrostatic_torque

Array = NDArray[np.float64]

# numba still calls first-class functions experimental; their types are fixed here once and for all.
warnings.filterwarnings("ignore", category=NumbaExperimentalFeatureWarning)

_f8, _vector = types.float64, types.float64[::1]

TORQUE = types.UniTuple(_f8, 3)(_f8, _f8, _f8, _f8, _f8, _f8, _f8, _vector, _vector)
"""(t, theta, omega, other, volt, z0, z1, p, nominal) -> (torque [N m], z0', z1').

``other`` is the other axis's angle, z0 and z1 are the term's own hidden states, ``p`` its parameters and ``nominal``
holds J, b, k, C0, theta0, theta_th, torque_per_volt (``NOMINAL``)."""

BELL = types.UniTuple(_f8, 2)(_f8, _vector, _vector)
"""(theta, p, nominal) -> (extra capacitance [F], its slope [F/rad])."""

NOMINAL = ("J", "b", "k", "C0", "theta0", "theta_th", "torque_per_volt")

SLOTS = 4
"""Mechanics terms at a time, and capacitance terms at a time."""


@njit(TORQUE, cache=True)
def no_torque(t, theta, omega, other, volt, z0, z1, p, nominal):  # type: ignore[no-untyped-def]
    return 0.0, 0.0, 0.0


@njit(BELL, cache=True)
def no_bell(theta, p, nominal):  # type: ignore[no-untyped-def]
    return 0.0, 0.0


_LAWS = types.Tuple(
    [types.UniTuple(types.FunctionType(TORQUE), SLOTS), _f8[:, ::1], types.int64,
     types.UniTuple(types.FunctionType(BELL), SLOTS), _f8[:, ::1], types.int64, _vector, types.boolean]
)  # fmt: skip
"""Torques, their parameters and number; bells, theirs; nominal values; whether the drive is electrostatic."""


@njit(inline="always")
def _extra_slope(theta, laws):  # type: ignore[no-untyped-def]
    """What the capacitance terms add to dC/dtheta."""
    bells, p, n, nominal = laws[3], laws[4], laws[5], laws[6]
    slope = 0.0
    for i in range(n):
        slope += bells[i](theta, p[i], nominal)[1]
    return slope


@njit(inline="always")
def _extra_torque(t, theta, omega, other, volt, z, dz, laws):  # type: ignore[no-untyped-def]
    """Torque of the mechanics terms; fills the rates ``dz`` of their hidden states."""
    torques, p, n, nominal = laws[0], laws[1], laws[2], laws[6]
    total = 0.0
    for i in range(n):
        torque, dz[i, 0], dz[i, 1] = torques[i](t, theta, omega, other, volt, z[i, 0], z[i, 1], p[i], nominal)
        total += torque
    return total


@njit(inline="always")
def _acceleration(t, theta, omega, other, volt, z, dz, laws, values):  # type: ignore[no-untyped-def]
    J, b, k, C0, theta0, theta_th, torque_per_volt = values
    torque = torque_per_volt * volt
    if laws[7]:
        slope = capacitance_slope(theta, C0, theta0, theta_th)
        if laws[5] > 0:
            slope += _extra_slope(theta, laws)
        torque += electrostatic_torque(slope, volt)
    if laws[2] > 0:
        torque += _extra_torque(t, theta, omega, other, volt, z, dz, laws)
    return angular_acceleration(theta, omega, torque, J, b, k)


@njit(inline="always")
def _advance(out, z, h, dz, n):  # type: ignore[no-untyped-def]
    for j in range(n):
        out[j, 0], out[j, 1] = z[j, 0] + h * dz[j, 0], z[j, 1] + h * dz[j, 1]


@njit(
    types.void(_f8, _f8, _f8[:, ::1], _f8[:, ::1], _f8[:, ::1], _f8, _f8, _LAWS, _vector, _vector),
    cache=True, nogil=True,
)  # fmt: skip
def _integrate(theta, omega, z, voltage, other, t, step, laws, angle, rate):  # type: ignore[no-untyped-def]
    half, n, nominal = 0.5 * step, laws[2], laws[6]
    # In registers: from an array they would be loaded anew at every stage, which takes longer than the stage itself.
    values = (nominal[0], nominal[1], nominal[2], nominal[3], nominal[4], nominal[5], nominal[6])
    z, mid = z.copy(), np.zeros_like(z)
    d1, d2, d3, d4 = np.zeros_like(z), np.zeros_like(z), np.zeros_like(z), np.zeros_like(z)
    angle[0], rate[0] = theta, omega
    for i in range(voltage.shape[0]):
        v0, v1, v2 = voltage[i, 0], voltage[i, 1], voltage[i, 2]
        o0, o1, o2 = other[i, 0], other[i, 1], other[i, 2]
        a1 = _acceleration(t, theta, omega, o0, v0, z, d1, laws, values)
        w2 = omega + half * a1
        _advance(mid, z, half, d1, n)
        a2 = _acceleration(t + half, theta + half * omega, w2, o1, v1, mid, d2, laws, values)
        w3 = omega + half * a2
        _advance(mid, z, half, d2, n)
        a3 = _acceleration(t + half, theta + half * w2, w3, o1, v1, mid, d3, laws, values)
        w4 = omega + step * a3
        _advance(mid, z, step, d3, n)
        a4 = _acceleration(t + step, theta + step * w3, w4, o2, v2, mid, d4, laws, values)
        theta += step / 6.0 * (omega + 2.0 * w2 + 2.0 * w3 + w4)
        omega += step / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)
        for j in range(n):
            for s in range(2):
                z[j, s] += step / 6.0 * (d1[j, s] + 2.0 * d2[j, s] + 2.0 * d3[j, s] + d4[j, s])
        t += step
        angle[i + 1], rate[i + 1] = theta, omega


(_integration,) = (made.entry_point for made in _integrate.overloads.values())  # type: ignore[attr-defined]
# Called past numba's dispatcher, which would find out anew at every call what functions these are: it takes as long
# as a thousand steps, and no other thread runs meanwhile. All arguments have to be of the types above.


@njit(types.void(types.FunctionType(BELL), _vector, _vector, _vector, _f8[:, ::1]), cache=True, nogil=True)
def _fill_bell(law, angle, p, nominal, out):  # type: ignore[no-untyped-def]
    for i in range(angle.size):
        out[0, i], out[1, i] = law(angle[i], p, nominal)


@dataclass(frozen=True)
class Torque:
    """A mechanics term as the kernel takes it: compiled law, parameters, hidden states at the start."""

    law: Callable[..., Any]
    parameters: Sequence[float]
    hidden: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Bell:
    """A capacitance term as the kernel takes it."""

    law: Callable[..., Any]
    parameters: Sequence[float]

    def along(self, angle: Array, axis: Axis) -> Array:
        """Extra capacitance [F] and slope [F/rad] at every angle (n,), shape (2, n)."""
        out = np.empty((2, angle.size))
        _fill_bell(_address(self.law), angle, np.asarray(self.parameters, float), nominal_values(axis), out)
        return out


def nominal_values(axis: Axis) -> Array:
    """``NOMINAL`` of an axis, shape (7,); zero (theta0: one) for what the axis does not have."""
    mechanics, comb, drive = axis.require_mechanics(), axis.capacitance, axis.drive
    bell = (comb.C0, comb.theta0, comb.theta_th) if comb else (0.0, 1.0, 0.0)
    push = (drive.torque_per_volt or 0.0) if drive and drive.kind == "linear" else 0.0
    return np.array([mechanics.J, mechanics.b, mechanics.k, *bell, push], np.float64)


def integrate(
    axis: Axis,
    start: tuple[float, float],
    voltage: Array,
    step: float,
    t0: float = 0.0,
    torques: Sequence[Torque] = (),
    bells: Sequence[Bell] = (),
    other: Array | None = None,
) -> tuple[Array, Array]:
    """Runge-Kutta of order 4 through the equation of motion with its terms.

    Args:
        start: angle [rad] and rate [rad/s].
        voltage: drive at the start, middle and end of every step, shape (n, 3) [V]; a jump between
            two steps stays sharp.
        step: [s].
        t0: time of the start [s].
        torques, bells: terms, at most ``SLOTS`` of each.
        other: the other axis's angle, shape (n, 3) [rad].

    Returns:
        (angle [rad], rate [rad/s]), each of shape (n + 1,), the start included.
    """
    n = len(voltage)
    angle, rate = np.empty(n + 1), np.empty(n + 1)
    hidden = np.zeros((SLOTS, 2))
    for i, torque in enumerate(torques):
        hidden[i] = torque.hidden
    electrostatic = bool(axis.drive is None or axis.drive.kind == "electrostatic") and axis.capacitance is not None
    laws = (
        _filled([each.law for each in torques], no_torque), _table([each.parameters for each in torques]), len(torques),
        _filled([each.law for each in bells], no_bell), _table([each.parameters for each in bells]), len(bells),
        nominal_values(axis), electrostatic,
    )  # fmt: skip
    others = np.zeros((n, 3)) if other is None else _doubles(other)
    theta, omega = float(start[0]), float(start[1])
    _integration(theta, omega, hidden, _doubles(voltage), others, float(t0), float(step), laws, angle, rate)
    return angle, rate


def _doubles(values: Array) -> Array:
    return np.ascontiguousarray(values, np.float64)


def thirds(half_steps: Array) -> Array:
    """What is told at every half step, shape (2 n + 1,), at the start, middle and end of every step, shape (n, 3)."""
    return np.stack([half_steps[:-2:2], half_steps[1::2], half_steps[2::2]], axis=1)


def halves(voltage: Array) -> Array:
    """What :func:`thirds` was made of: every half step of (n, 3) once, shape (2 n + 1,)."""
    return np.append(voltage[:, :2].ravel(), voltage[-1, 2])


class _Address(types.WrapperAddressProtocol):
    """A compiled law by its address: asking numba for it anew at every call would cost more than the integration."""

    def __init__(self, law: Callable[..., Any]):
        self._signature = law.nopython_signatures[0]  # type: ignore[attr-defined]
        self._address = _get_wrapper_address(law, self._signature)

    def __wrapper_address__(self) -> int:
        return self._address

    def signature(self) -> Any:
        return self._signature


@cache
def _address(law: Callable[..., Any]) -> _Address:
    return _Address(law)


def _filled(laws: list[Callable[..., Any]], nothing: Callable[..., Any]) -> tuple[_Address, ...]:
    if len(laws) > SLOTS:
        raise ValueError(f"{len(laws)} terms of one stage, the trajectory has room for {SLOTS}")
    return tuple(_address(law) for law in (*laws, *[nothing] * (SLOTS - len(laws))))


def _table(rows: Sequence[Sequence[float]]) -> Array:
    table = np.zeros((SLOTS, max([1, *map(len, rows)])))
    for i, row in enumerate(rows):
        table[i, : len(row)] = row
    return table
