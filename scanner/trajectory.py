"""The equation of motion with any set of extra physics, integrated by one compiled kernel.

A mechanics term hands over its torque, a capacitance term its extra bell, as compiled functions that the kernel calls
through their addresses: a new term needs no new kernel, and one compilation serves all of them. Terms of the other
stages act on whole arrays before or after the integration and never come here.

A step waits for its own stages most of the time. Motions that differ in numbers alone, as a derivative by differences
asks for, go side by side in the lanes of the processor's vectors: eight take little longer than one. A term's law is
written for one motion; what the kernel calls is the same law in all lanes, for a call takes longer than most laws.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from math import factorial
from typing import Any, NamedTuple

import numpy as np
from numba import NumbaExperimentalFeatureWarning, carray, njit, types
from numba.experimental.function_type import _get_wrapper_address
from numba.extending import intrinsic, register_jitable
from numpy.typing import NDArray

from scanner.device import Axis
from scanner.laws import angular_acceleration, bell_slope, electrostatic_torque

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

LANES, BYTES = 8, 8
"""Motions side by side; of a double."""

_ABREAST = types.void(types.int64, _f8, _f8, _f8, *[types.int64] * 8)
"""(s, t, other, volt, at, rate, z, dz, p, most, own, used): one slot's law in the lanes that are used, added to
``MORE_TORQUE`` or ``MORE_SLOPE`` of s. s, p and own are addresses, which cost less to hand over than arrays: of the
kernel's numbers (``ROWS``), of the slot's first lane in a table of parameters (``_LAWS``) that has room for ``most`` in
a slot, and of the nominal values."""

_SLOTS_OF = types.UniTuple(types.FunctionType(_ABREAST), SLOTS)

_LAWS = types.Tuple(
    [_SLOTS_OF, _f8[:, :, ::1], types.int64, _SLOTS_OF, _f8[:, :, ::1], types.int64, _f8[:, ::1], _f8, types.int64]
)
"""Torques, their parameters by lane and slot, their number; bells, likewise; nominal values by lane; the share of the
drive's voltage that pulls: 1 for an electrostatic drive, else 0; hidden states."""

_COMPILED: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract"}}

LN2_HIGH, LN2_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10  # in two parts, the first with room for k
ROUNDER = 1.5 * 2.0**52  # added to a number, leaves it rounded to an integer, which then stands in the lowest bits
ROUNDER_BITS = int(np.float64(ROUNDER).view(np.int64))
C2, C3, C4, C5, C6, C7, C8, C9, C10, C11, C12, C13 = (1.0 / factorial(n) for n in range(2, 14))

(THETA, OMEGA, MORE_TORQUE, MORE_SLOPE, A1, A2, A3, W2, W3, W4, MID,
 J, B, K, C0, THETA0, THETA_TH, PUSH) = range(18)  # fmt: skip
Z, Z_MID, Z1, Z2, Z3, Z4 = (18 + 2 * SLOTS * i for i in range(6))
ROWS = 18 + 12 * SLOTS
"""Rows of the kernel's numbers, (ROWS, LANES): the motion; what its terms add; accelerations and rates of a step's
stages and the angle at the next; the nominal values; the hidden states slot by slot, at the start of a step and at a
stage, and their rates at the four stages."""


@njit(forceinline=True, **_COMPILED)
def _exponential(x):  # type: ignore[no-untyped-def]
    """exp(x) for x <= 0 to 3e-16 of itself, 1e-304 below -700: without a call, so that it goes on in all lanes."""
    x = x if x > -700.0 else -700.0
    rounded = x * (1.0 / (LN2_HIGH + LN2_LOW)) + ROUNDER
    k = rounded - ROUNDER
    r = (x - k * LN2_HIGH) - k * LN2_LOW
    p = C6 + r * (C7 + r * (C8 + r * (C9 + r * (C10 + r * (C11 + r * (C12 + r * C13))))))
    p = 1.0 + r * (1.0 + r * (C2 + r * (C3 + r * (C4 + r * (C5 + r * p)))))
    power = np.int64((np.float64(rounded).view(np.int64) - ROUNDER_BITS + 1023) << 52)  # the bits of 2^k
    return p * power.view(np.float64)


@intrinsic
def _pointer(context, address):  # type: ignore[no-untyped-def]
    def code(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return builder.inttoptr(arguments[0], context.get_value_type(signature.return_type))

    return types.CPointer(_f8)(types.int64), code


@njit(inline="always")
def _place(array):  # type: ignore[no-untyped-def]
    return np.int64(array.ctypes.data)


class _Address(types.WrapperAddressProtocol):
    """A compiled function by its address: to ask numba for it at every call would take longer than an integration."""

    def __init__(self, function: Callable[..., Any]):
        self._signature = function.nopython_signatures[0]  # type: ignore[attr-defined]
        self._address = _get_wrapper_address(function, self._signature)

    def __wrapper_address__(self) -> int:
        return self._address

    def signature(self) -> Any:
        return self._signature


_address = cache(_Address)


@njit(_ABREAST, cache=True)
def _nothing(s, t, other, volt, at, rate, z, dz, p, most, own, used):  # type: ignore[no-untyped-def]
    pass


@cache
def _abreast(law: Callable[..., Any]) -> _Address:
    """A law, compiled with ``TORQUE`` or ``BELL``, in all lanes.

    numba keeps it on disk by what it closes over: the law's name, and ``stamp``, what the law says.
    """
    one, code = register_jitable(law.py_func), law.py_func.__code__  # type: ignore[attr-defined]
    stamp = repr((code.co_code, code.co_consts, code.co_names))

    def torque(s, t, other, volt, at, rate, z, dz, p, most, own, used):  # type: ignore[no-untyped-def]
        stamp  # noqa: B018
        s, own = carray(_pointer(s), (ROWS, LANES)), carray(_pointer(own), (LANES, len(NOMINAL)))
        for lane in range(used):
            values = carray(_pointer(p + lane * SLOTS * most * BYTES), (most,))
            more, s[dz, lane], s[dz + 1, lane] = one(
                t, s[at, lane], s[rate, lane], other, volt, s[z, lane], s[z + 1, lane], values, own[lane]
            )
            s[MORE_TORQUE, lane] += more

    def bell(s, t, other, volt, at, rate, z, dz, p, most, own, used):  # type: ignore[no-untyped-def]
        stamp  # noqa: B018
        s, own = carray(_pointer(s), (ROWS, LANES)), carray(_pointer(own), (LANES, len(NOMINAL)))
        for lane in range(used):
            values = carray(_pointer(p + lane * SLOTS * most * BYTES), (most,))
            s[MORE_SLOPE, lane] += one(s[at, lane], values, own[lane])[1]

    every = torque if law.nopython_signatures[0] == TORQUE else bell  # type: ignore[attr-defined]
    return _Address(njit(_ABREAST, cache=True, nogil=True, **_COMPILED)(every))


@njit(forceinline=True, **_COMPILED)
def _terms(t, at, rate, z, dz, other, volt, laws, s, used):  # type: ignore[no-untyped-def]
    """What terms add, in all lanes: ``MORE_TORQUE``, ``MORE_SLOPE``, and the rates ``dz`` of their hidden states."""
    (first, second, third, fourth), n, bells = laws[0], laws[2], laws[3]  # by number they would be copied every time
    here, own = _place(s), _place(laws[6])
    s[MORE_TORQUE], s[MORE_SLOPE] = 0.0, 0.0
    p, most = _place(laws[1]), laws[1].shape[2]
    slot = most * BYTES
    if n > 0:
        first(here, t, other, volt, at, rate, z, dz, p, most, own, used)
    if n > 1:
        second(here, t, other, volt, at, rate, z + 2, dz + 2, p + slot, most, own, used)
    if n > 2:
        third(here, t, other, volt, at, rate, z + 4, dz + 4, p + 2 * slot, most, own, used)
    if n > 3:
        fourth(here, t, other, volt, at, rate, z + 6, dz + 6, p + 3 * slot, most, own, used)
    p, most = _place(laws[4]), laws[4].shape[2]
    for i in range(laws[5]):
        bells[i](here, t, other, volt, at, rate, z, dz, p + i * most * BYTES, most, own, used)


@njit(forceinline=True, **_COMPILED)
def _acceleration(s, lane, at, rate, volt, pull):  # type: ignore[no-untyped-def]
    u = (s[at, lane] - s[THETA_TH, lane]) / s[THETA0, lane]
    slope = bell_slope(u, _exponential(-u * u), s[C0, lane], s[THETA0, lane]) + s[MORE_SLOPE, lane]
    torque = s[PUSH, lane] * volt + electrostatic_torque(slope, pull) + s[MORE_TORQUE, lane]
    return angular_acceleration(s[at, lane], s[rate, lane], torque, s[J, lane], s[B, lane], s[K, lane])


@njit(forceinline=True, **_COMPILED)
def _advance(dz, h, s, states, width):  # type: ignore[no-untyped-def]
    for i in range(states):
        for lane in range(width):
            s[Z_MID + i, lane] = s[Z + i, lane] + h * s[dz + i, lane]


@njit(
    types.void(_f8[:, ::1], _f8[:, ::1], _f8[:, ::1], _f8, _f8, _LAWS, types.int64, _f8[:, ::1], _f8[:, ::1]),
    cache=True, nogil=True, **_COMPILED,
)  # fmt: skip
def _integrate(start, voltage, other, t, step, laws, width, angle, rate):  # type: ignore[no-untyped-def]
    """``start``: angle, rate, hidden states by lane. ``width``: lanes computed, more than used to fill vectors."""
    half, used, some, states = 0.5 * step, start.shape[0], laws[2] + laws[5] > 0, laws[8]
    s = np.zeros((ROWS, LANES))
    for lane in range(width):
        own = min(lane, used - 1)
        s[THETA, lane], s[OMEGA, lane] = start[own, 0], start[own, 1]
        s[Z : Z + 2 * SLOTS, lane] = start[own, 2:]
        s[J : PUSH + 1, lane] = laws[6][own]
    s[Z_MID : Z_MID + 2 * SLOTS] = s[Z : Z + 2 * SLOTS]
    angle[:, 0], rate[:, 0] = start[:, 0], start[:, 1]
    for i in range(voltage.shape[0]):
        v0, v1, v2 = voltage[i, 0], voltage[i, 1], voltage[i, 2]
        p0, p1, p2 = laws[7] * v0, laws[7] * v1, laws[7] * v2
        o0, o1, o2 = other[i, 0], other[i, 1], other[i, 2]
        if some:
            _terms(t, THETA, OMEGA, Z, Z1, o0, v0, laws, s, used)
            _advance(Z1, half, s, states, width)
        for lane in range(width):
            s[A1, lane] = _acceleration(s, lane, THETA, OMEGA, v0, p0)
            s[W2, lane] = s[OMEGA, lane] + half * s[A1, lane]
            s[MID, lane] = s[THETA, lane] + half * s[OMEGA, lane]
        if some:
            _terms(t + half, MID, W2, Z_MID, Z2, o1, v1, laws, s, used)
            _advance(Z2, half, s, states, width)
        for lane in range(width):
            s[A2, lane] = _acceleration(s, lane, MID, W2, v1, p1)
            s[W3, lane] = s[OMEGA, lane] + half * s[A2, lane]
            s[MID, lane] = s[THETA, lane] + half * s[W2, lane]
        if some:
            _terms(t + half, MID, W3, Z_MID, Z3, o1, v1, laws, s, used)
            _advance(Z3, step, s, states, width)
        for lane in range(width):
            s[A3, lane] = _acceleration(s, lane, MID, W3, v1, p1)
            s[W4, lane] = s[OMEGA, lane] + step * s[A3, lane]
            s[MID, lane] = s[THETA, lane] + step * s[W3, lane]
        if some:
            _terms(t + step, MID, W4, Z_MID, Z4, o2, v2, laws, s, used)
            for k in range(states):
                for lane in range(width):
                    rates = s[Z1 + k, lane] + 2.0 * s[Z2 + k, lane] + 2.0 * s[Z3 + k, lane] + s[Z4 + k, lane]
                    s[Z + k, lane] += step / 6.0 * rates
        for lane in range(width):
            a4 = _acceleration(s, lane, MID, W4, v2, p2)
            s[THETA, lane] += step / 6.0 * (s[OMEGA, lane] + 2.0 * s[W2, lane] + 2.0 * s[W3, lane] + s[W4, lane])
            s[OMEGA, lane] += step / 6.0 * (s[A1, lane] + 2.0 * s[A2, lane] + 2.0 * s[A3, lane] + a4)
        for lane in range(used):
            angle[lane, i + 1], rate[lane, i + 1] = s[THETA, lane], s[OMEGA, lane]
        t += step


(_integration,) = (made.entry_point for made in _integrate.overloads.values())  # type: ignore[attr-defined]
# Called past numba's dispatcher, which would find out anew at every call what functions these are: it takes as long
# as a thousand steps, and no other thread runs meanwhile. All arguments have to be of the types above.


@njit(types.void(types.FunctionType(BELL), _vector, _vector, _vector, _f8[:, ::1]), cache=True, nogil=True)
def _fill_bell(law, angle, p, nominal, out):  # type: ignore[no-untyped-def]
    for i in range(angle.size):
        out[0, i], out[1, i] = law(angle[i], p, nominal)


@dataclass(frozen=True)
class Torque:
    """A mechanics term as the kernel takes it: compiled law, parameters, hidden states at the start if it has any."""

    law: Callable[..., Any]
    parameters: Sequence[float]
    hidden: tuple[float, float] | None = None


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


class Motion(NamedTuple):
    """One of the motions that go side by side.

    Attributes:
        axis: nominal values.
        start: angle [rad] and rate [rad/s].
        torques, bells: terms, at most ``SLOTS`` of each.
    """

    axis: Axis
    start: tuple[float, float]
    torques: Sequence[Torque] = ()
    bells: Sequence[Bell] = ()


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
        voltage, step, t0, other: as in :func:`side_by_side`.
        torques, bells: terms, at most ``SLOTS`` of each.

    Returns:
        (angle [rad], rate [rad/s]), each of shape (n + 1,), the start included.
    """
    return side_by_side([Motion(axis, start, torques, bells)], voltage, step, t0, other)[0]


def side_by_side(
    motions: Sequence[Motion], voltage: Array, step: float, t0: float = 0.0, other: Array | None = None
) -> list[tuple[Array, Array]]:
    """:func:`integrate` of at most ``LANES`` motions with the same laws, whose numbers may differ, under one drive.

    Args:
        voltage: drive at the start, middle and end of every step, shape (n, 3) [V]; a jump between
            two steps stays sharp.
        step: [s].
        t0: time of the start [s].
        other: the other axis's angle, shape (n, 3) [rad].
    """
    n, lanes, first = len(voltage), len(motions), motions[0]
    angle, rate = np.empty((lanes, n + 1)), np.empty((lanes, n + 1))
    start = np.zeros((lanes, 2 + 2 * SLOTS))
    for own, motion in zip(start, motions, strict=True):
        own[:2] = motion.start
        for i, torque in enumerate(motion.torques):
            own[2 + 2 * i : 4 + 2 * i] = torque.hidden or 0.0
    drive = first.axis.drive
    electrostatic = (drive is None or drive.kind == "electrostatic") and first.axis.capacitance is not None
    laws = (
        _filled([each.law for each in first.torques]),
        _table([[each.parameters for each in motion.torques] for motion in motions]), len(first.torques),
        _filled([each.law for each in first.bells]),
        _table([[each.parameters for each in motion.bells] for motion in motions]), len(first.bells),
        np.stack([nominal_values(motion.axis) for motion in motions]), float(electrostatic),
        2 * len(first.torques) if any(torque.hidden for torque in first.torques) else 0,
    )  # fmt: skip
    others = np.zeros((n, 3)) if other is None else _doubles(other)
    width = 4 * -(-lanes // 4)
    _integration(start, _doubles(voltage), others, float(t0), float(step), laws, width, angle, rate)
    return [(a.copy(), r.copy()) for a, r in zip(angle, rate, strict=True)]  # who keeps one does not keep all


def _doubles(values: Array) -> Array:
    return np.ascontiguousarray(values, np.float64)


def thirds(half_steps: Array) -> Array:
    """What is told at every half step, shape (2 n + 1,), at the start, middle and end of every step, shape (n, 3)."""
    return np.stack([half_steps[:-2:2], half_steps[1::2], half_steps[2::2]], axis=1)


def halves(voltage: Array) -> Array:
    """What :func:`thirds` was made of: every half step of (n, 3) once, shape (2 n + 1,)."""
    return np.append(voltage[:, :2].ravel(), voltage[-1, 2])


def _filled(laws: list[Callable[..., Any]]) -> tuple[_Address, ...]:
    if len(laws) > SLOTS:
        raise ValueError(f"{len(laws)} terms of one stage, the trajectory has room for {SLOTS}")
    return tuple(map(_abreast, laws)) + (_address(_nothing),) * (SLOTS - len(laws))


def _table(parameters: Sequence[Sequence[Sequence[float]]]) -> Array:
    """By lane and slot, shape (lanes, ``SLOTS``, most of any)."""
    table = np.zeros((len(parameters), SLOTS, max([1, *(len(row) for rows in parameters for row in rows)])))
    for own, rows in zip(table, parameters, strict=True):
        for i, row in enumerate(rows):
            own[i, : len(row)] = row
    return table
