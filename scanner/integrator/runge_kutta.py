"""The compiled integrator: Runge-Kutta of order 4 for up to eight motions in the lanes of the processor's vectors.

Within one motion the stages of a step depend on each other, so the processor waits for most of the time. Motions that
have the same laws and differ in numbers only, such as those of a Jacobian by differences, are computed in parallel
lanes: eight take little longer than one. A law is written for one motion. It is compiled once more into a function that
evaluates it in all lanes, because a call takes longer than most laws.
"""

from __future__ import annotations

import linecache
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numba import carray, njit, types
from numba.extending import intrinsic, register_jitable

from scanner.integrator.abi import LANES, MAX_TERMS_PER_STAGE, TORQUE_LAW, Nominal
from scanner.integrator.elementary import negative_exponential
from scanner.integrator.function_addresses import FunctionAddress
from scanner.integrator.lane_parameters import lane_parameters
from scanner.laws import angular_acceleration, electrostatic_torque, gaussian_slope

BYTES_PER_FLOAT = 8

_f8, _i8 = types.float64, types.int64

_LANE_LAW = types.void(_i8, _f8, _f8, _i8, _i8, _i8)
"""(state, t, other, p, p_count, lanes): one law in the first ``lanes`` lanes.

It reads the rows ``LAW_THETA`` to ``LAW_VOLT`` of the state and adds its result to the row ``TERM_TORQUE`` or
``TERM_SLOPE``. A torque law sets the rows ``LAW_DZ``. The rows are the same for all laws and stages, so the compiler
knows that no two of them overlap and computes several lanes at once. state and p are addresses, which are cheaper to
pass than arrays: of the state (``ROWS``, ``LANES``) and of the law's parameters (``p_count``, ``LANES``)."""

_LANE_LAWS = types.UniTuple(types.FunctionType(_LANE_LAW), MAX_TERMS_PER_STAGE)

_LAWS = types.Tuple(
    [_LANE_LAWS, _f8[:, :, ::1], _i8, _LANE_LAWS, _f8[:, :, ::1], _i8, _f8[:, ::1], _f8, _i8]
)  # fmt: skip
"""Torque laws, their parameters by term, place and lane, their number; the same of the capacitance laws; nominal values
by motion; 1.0 for an electrostatic drive and 0.0 for another; number of hidden states."""

_COMPILER_OPTIONS: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract"}}

(THETA, OMEGA, TERM_TORQUE, TERM_SLOPE, ALPHA1, ALPHA2, ALPHA3, OMEGA2, OMEGA3, OMEGA4, STAGE_THETA,
 PER_J, B_PER_J, K_PER_J, C0_PER_THETA0, PER_THETA0, THETA_TH, TORQUE_PER_VOLT,
 VOLT1, VOLT2, VOLT3, LAW_THETA, LAW_OMEGA) = range(23)  # fmt: skip
LAW_Z, LAW_DZ, LAW_NOMINAL, LAW_VOLT = 23, 25, 27, 34
Z, STAGE_Z, DZ1, DZ2, DZ3, DZ4 = (35 + 2 * MAX_TERMS_PER_STAGE * i for i in range(6))
ROWS = 35 + 12 * MAX_TERMS_PER_STAGE
"""Rows of the state, shape (ROWS, LANES).

Angle and rate at the start of the step; torque and slope of the capacitance that the terms add; accelerations and rates
of the four stages of the step, and the angle of the present stage; nominal values, divided before, because a division
takes longer than all other operations of a law; drive at the start, middle and end of the step; what a law reads and
sets: angle, rate, two hidden states and their derivatives, the seven nominal values and the drive; then, two for each
torque law, the hidden states at the start of the step and at the present stage, and their derivatives at the four
stages."""


@intrinsic
def _pointer(context, address):  # type: ignore[no-untyped-def]
    """A pointer to doubles from an address."""

    def code(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return builder.inttoptr(arguments[0], context.get_value_type(signature.return_type))

    return types.CPointer(_f8)(_i8), code


@njit(inline="always")
def _data_address(array):  # type: ignore[no-untyped-def]
    return np.int64(array.ctypes.data)


@njit(_LANE_LAW, cache=True)
def no_law(state, t, other, p, p_count, lanes):  # type: ignore[no-untyped-def]
    """The law in the place of a term that is not there. The kernel never calls it."""


@cache
def in_all_lanes(law: Callable[..., Any]) -> FunctionAddress:
    """Return the address of a function that evaluates ``law``, which has a signature of ``abi``, in all lanes.

    numba caches the function on disk under the values in its closure: the name of the law, and the text of the file
    that defines it, with the constants and functions that it uses.
    """
    inlined = register_jitable(forceinline=True)(law.py_func)  # type: ignore[attr-defined]
    linecache.checkcache(law.py_func.__code__.co_filename)  # type: ignore[attr-defined]
    law_file = "".join(linecache.getlines(law.py_func.__code__.co_filename))  # type: ignore[attr-defined]

    def torque(state, t, other, p, p_count, lanes):  # type: ignore[no-untyped-def]
        law_file  # noqa: B018
        s, table = carray(_pointer(state), (ROWS, LANES)), _pointer(p)
        for lane in range(lanes):
            added, s[LAW_DZ, lane], s[LAW_DZ + 1, lane] = inlined(
                t, s[LAW_THETA, lane], s[LAW_OMEGA, lane], other, s[LAW_VOLT, lane], s[LAW_Z, lane],
                s[LAW_Z + 1, lane], lane_parameters(table, p_count, lane), _nominal(s, lane),
            )  # fmt: skip
            s[TERM_TORQUE, lane] += added

    def slope(state, t, other, p, p_count, lanes):  # type: ignore[no-untyped-def]
        law_file  # noqa: B018
        s, table = carray(_pointer(state), (ROWS, LANES)), _pointer(p)
        for lane in range(lanes):
            s[TERM_SLOPE, lane] += inlined(
                s[LAW_THETA, lane], lane_parameters(table, p_count, lane), _nominal(s, lane)
            )[1]

    lane_law = torque if law.nopython_signatures[0] == TORQUE_LAW else slope  # type: ignore[attr-defined]
    return FunctionAddress(njit(_LANE_LAW, cache=True, nogil=True, **_COMPILER_OPTIONS)(lane_law))


@njit(forceinline=True)
def _nominal(s, lane):  # type: ignore[no-untyped-def]
    """The nominal values of a lane."""
    return Nominal(
        s[LAW_NOMINAL, lane], s[LAW_NOMINAL + 1, lane], s[LAW_NOMINAL + 2, lane], s[LAW_NOMINAL + 3, lane],
        s[LAW_NOMINAL + 4, lane], s[LAW_NOMINAL + 5, lane], s[LAW_NOMINAL + 6, lane],
    )  # fmt: skip


@njit(forceinline=True, **_COMPILER_OPTIONS)
def _terms(s, laws):  # type: ignore[no-untyped-def]
    """What :func:`_evaluate_terms` needs of the state and the laws, without an array: a function that is passed an
    array counts references to it, which takes longer than most laws.

    Torque laws, their number, address and number of places of their parameters; the same of the capacitance laws;
    address of the state; number of hidden states.
    """
    return (
        laws[0], laws[2], _data_address(laws[1]), laws[1].shape[1],
        laws[3], laws[5], _data_address(laws[4]), laws[4].shape[1],
        _data_address(s), laws[8],
    )  # fmt: skip


@njit(forceinline=True, **_COMPILER_OPTIONS)
def _evaluate_terms(t, theta_row, omega_row, volt_row, z_row, dz_row, other, terms, lanes):  # type: ignore[no-untyped-def]
    """Set ``TERM_TORQUE``, ``TERM_SLOPE`` and the derivatives ``dz_row`` of the hidden states, in ``lanes`` lanes."""
    # Unpacked, because an index into the tuple would copy all of its functions at every call.
    (first, second, third, fourth), n, p, count, slopes, m, slopes_p, slopes_count, state, hidden = terms
    s = carray(_pointer(state), (ROWS, LANES))
    for lane in range(LANES):
        s[LAW_THETA, lane], s[LAW_OMEGA, lane] = s[theta_row, lane], s[omega_row, lane]
        s[LAW_VOLT, lane] = s[volt_row, lane]
        s[TERM_TORQUE, lane], s[TERM_SLOPE, lane] = 0.0, 0.0
    of_term = count * LANES * BYTES_PER_FLOAT
    if n > 0:
        _evaluate_torque(first, state, t, other, p, count, lanes, z_row, dz_row, hidden)
    if n > 1:
        _evaluate_torque(second, state, t, other, p + of_term, count, lanes, z_row + 2, dz_row + 2, hidden)
    if n > 2:
        _evaluate_torque(third, state, t, other, p + 2 * of_term, count, lanes, z_row + 4, dz_row + 4, hidden)
    if n > 3:
        _evaluate_torque(fourth, state, t, other, p + 3 * of_term, count, lanes, z_row + 6, dz_row + 6, hidden)
    of_term = slopes_count * LANES * BYTES_PER_FLOAT
    for i in range(m):
        slopes[i](state, t, other, slopes_p + i * of_term, slopes_count, lanes)


@njit(forceinline=True)
def _evaluate_torque(law, state, t, other, p, count, lanes, z_row, dz_row, hidden):  # type: ignore[no-untyped-def]
    """Add a torque law; its hidden states, if any law has some, are read from and their derivatives stored in rows."""
    if hidden > 0:
        _copy_two_rows(state, z_row, LAW_Z)
    law(state, t, other, p, count, lanes)
    if hidden > 0:
        _copy_two_rows(state, LAW_DZ, dz_row)


@njit(forceinline=True)
def _copy_two_rows(state, source, target):  # type: ignore[no-untyped-def]
    s = carray(_pointer(state), (ROWS, LANES))
    for lane in range(LANES):
        s[target, lane], s[target + 1, lane] = s[source, lane], s[source + 1, lane]


@njit(forceinline=True, **_COMPILER_OPTIONS)
def _acceleration(s, lane, theta_row, omega_row, volt_row, electrostatic):  # type: ignore[no-untyped-def]
    """Angular acceleration in one lane [rad/s2], from the nominal laws and what the terms add."""
    torque = s[TORQUE_PER_VOLT, lane] * s[volt_row, lane] + s[TERM_TORQUE, lane]
    if electrostatic:
        u = (s[theta_row, lane] - s[THETA_TH, lane]) * s[PER_THETA0, lane]
        slope = gaussian_slope(u, negative_exponential(-u * u), s[C0_PER_THETA0, lane], 1.0) + s[TERM_SLOPE, lane]
        torque += electrostatic_torque(slope, s[volt_row, lane])
    # of a unit of inertia
    return angular_acceleration(
        s[theta_row, lane], s[omega_row, lane], torque * s[PER_J, lane], 1.0, s[B_PER_J, lane], s[K_PER_J, lane]
    )


@njit(forceinline=True, **_COMPILER_OPTIONS)
def _set_stage_z(dz_row, h, s, hidden_states, width):  # type: ignore[no-untyped-def]
    """Set the hidden states at the next stage, ``h`` after the start of the step, from their derivatives."""
    for i in range(hidden_states):
        for lane in range(width):
            s[STAGE_Z + i, lane] = s[Z + i, lane] + h * s[dz_row + i, lane]


@njit(forceinline=True)
def _load_drives(s, width, voltages, step):  # type: ignore[no-untyped-def]
    """Set the drive at the three nodes of a step, in each lane that of ``voltages`` or the same in all."""
    voltage, first = _pointer(voltages[0]), 3 * step
    v1, v2, v3 = voltage[first], voltage[first + 1], voltage[first + 2]
    for lane in range(width):
        s[VOLT1, lane], s[VOLT2, lane], s[VOLT3, lane] = v1, v2, v3
    for lane in range(1, voltages.size):
        voltage = _pointer(voltages[lane])
        s[VOLT1, lane], s[VOLT2, lane], s[VOLT3, lane] = voltage[first], voltage[first + 1], voltage[first + 2]


@njit(forceinline=True)
def _store(s, used, results, place):  # type: ignore[no-untyped-def]
    """Store angle and rate of the first ``used`` lanes in place ``place`` of their arrays."""
    for lane in range(used):
        angle, rate = _pointer(results[lane, 0]), _pointer(results[lane, 1])
        angle[place], rate[place] = s[THETA, lane], s[OMEGA, lane]


@njit(
    types.void(_f8[:, ::1], _i8[::1], _f8[:, ::1], _f8, _f8, _LAWS, _i8, _i8[:, ::1]),
    cache=True, nogil=True, **_COMPILER_OPTIONS,
)  # fmt: skip
def _integrate(start, voltages, other, t, step, laws, width, results):  # type: ignore[no-untyped-def]
    """Integrate all motions through all steps and store angle and rate at the addresses ``results``.

    ``start``: angle, rate and hidden states, shape (motions, 2 + 2 MAX_TERMS_PER_STAGE). ``voltages``: addresses of the
    drives at the nodes of every step, arrays of shape (n, 3): one of each motion, or a single one of all. ``other``: at
    the nodes, shape (n, 3). ``width``: lanes computed; those beyond the number of motions fill a vector. ``results``:
    of the two arrays of each motion, with n + 1 places each, shape (motions, 2).
    """
    half, used, any_term, hidden_states = 0.5 * step, start.shape[0], laws[2] + laws[5] > 0, laws[8]
    electrostatic = laws[7] > 0.0
    s = np.zeros((ROWS, LANES))
    for lane in range(width):
        motion = min(lane, used - 1)
        s[THETA, lane], s[OMEGA, lane] = start[motion, 0], start[motion, 1]
        s[Z : Z + 2 * MAX_TERMS_PER_STAGE, lane] = start[motion, 2:]
        J, b, k, C0, theta0, theta_th, torque_per_volt = laws[6][motion]
        s[LAW_NOMINAL : LAW_NOMINAL + 7, lane] = laws[6][motion]
        s[PER_J, lane], s[B_PER_J, lane], s[K_PER_J, lane] = 1.0 / J, b / J, k / J
        s[C0_PER_THETA0, lane], s[PER_THETA0, lane] = C0 / theta0, 1.0 / theta0
        s[THETA_TH, lane], s[TORQUE_PER_VOLT, lane] = theta_th, torque_per_volt
    s[STAGE_Z : STAGE_Z + 2 * MAX_TERMS_PER_STAGE] = s[Z : Z + 2 * MAX_TERMS_PER_STAGE]
    _store(s, used, results, 0)
    terms, law_lanes = _terms(s, laws), 1 if used == 1 else width  # whole vectors where there are several
    for i in range(other.shape[0]):
        _load_drives(s, width, voltages, i)
        o0, o1, o2 = other[i, 0], other[i, 1], other[i, 2]
        if any_term:
            _evaluate_terms(t, THETA, OMEGA, VOLT1, Z, DZ1, o0, terms, law_lanes)
            _set_stage_z(DZ1, half, s, hidden_states, width)
        for lane in range(width):
            s[ALPHA1, lane] = _acceleration(s, lane, THETA, OMEGA, VOLT1, electrostatic)
            s[OMEGA2, lane] = s[OMEGA, lane] + half * s[ALPHA1, lane]
            s[STAGE_THETA, lane] = s[THETA, lane] + half * s[OMEGA, lane]
        if any_term:
            _evaluate_terms(t + half, STAGE_THETA, OMEGA2, VOLT2, STAGE_Z, DZ2, o1, terms, law_lanes)
            _set_stage_z(DZ2, half, s, hidden_states, width)
        for lane in range(width):
            s[ALPHA2, lane] = _acceleration(s, lane, STAGE_THETA, OMEGA2, VOLT2, electrostatic)
            s[OMEGA3, lane] = s[OMEGA, lane] + half * s[ALPHA2, lane]
            s[STAGE_THETA, lane] = s[THETA, lane] + half * s[OMEGA2, lane]
        if any_term:
            _evaluate_terms(t + half, STAGE_THETA, OMEGA3, VOLT2, STAGE_Z, DZ3, o1, terms, law_lanes)
            _set_stage_z(DZ3, step, s, hidden_states, width)
        for lane in range(width):
            s[ALPHA3, lane] = _acceleration(s, lane, STAGE_THETA, OMEGA3, VOLT2, electrostatic)
            s[OMEGA4, lane] = s[OMEGA, lane] + step * s[ALPHA3, lane]
            s[STAGE_THETA, lane] = s[THETA, lane] + step * s[OMEGA3, lane]
        if any_term:
            _evaluate_terms(t + step, STAGE_THETA, OMEGA4, VOLT3, STAGE_Z, DZ4, o2, terms, law_lanes)
            for k in range(hidden_states):
                for lane in range(width):
                    rates = s[DZ1 + k, lane] + 2.0 * s[DZ2 + k, lane] + 2.0 * s[DZ3 + k, lane] + s[DZ4 + k, lane]
                    s[Z + k, lane] += step / 6.0 * rates
        for lane in range(width):
            alpha4 = _acceleration(s, lane, STAGE_THETA, OMEGA4, VOLT3, electrostatic)
            omegas = s[OMEGA, lane] + 2.0 * s[OMEGA2, lane] + 2.0 * s[OMEGA3, lane] + s[OMEGA4, lane]
            alphas = s[ALPHA1, lane] + 2.0 * s[ALPHA2, lane] + 2.0 * s[ALPHA3, lane] + alpha4
            s[THETA, lane] += step / 6.0 * omegas
            s[OMEGA, lane] += step / 6.0 * alphas
        _store(s, used, results, i + 1)
        t += step


(run_kernel,) = (compiled.entry_point for compiled in _integrate.overloads.values())  # type: ignore[attr-defined]
# The compiled kernel without numba's dispatcher. The dispatcher would determine the types of all laws at every call,
# which takes as long as a thousand steps and blocks other threads. All arguments must have exactly the types above.
