"""Trajectories: what the integrator integrates, and the functions that call it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numba import njit, types

from scanner.arrays import Array
from scanner.device import Axis
from scanner.errors import BadInput
from scanner.integrator.abi import CAPACITANCE_LAW, LANES, MAX_TERMS_PER_STAGE, NOMINAL_TYPE, nominal_values
from scanner.integrator.function_addresses import FunctionAddress, address_of
from scanner.integrator.runge_kutta import in_all_lanes, no_law, run_kernel

_f8, _vector = types.float64, types.float64[::1]

_LANES_PER_VECTOR = 4
"""Doubles in an AVX register; the kernel computes whole registers."""


@njit(
    types.void(types.FunctionType(CAPACITANCE_LAW), _vector, _vector, NOMINAL_TYPE, _f8[:, ::1]), cache=True, nogil=True
)
def _evaluate_capacitance(law, angle, p, nominal, out):  # type: ignore[no-untyped-def]
    for i in range(angle.size):
        out[0, i], out[1, i] = law(angle[i], p, nominal)


@dataclass(frozen=True)
class TorqueTerm:
    """A mechanics term for the integrator.

    Attributes:
        law: compiled with ``scanner.integrator.abi.TORQUE_LAW``.
        parameters: of the law [SI].
        hidden_state: at the start; None for a law without hidden states.
    """

    law: Callable[..., Any]
    parameters: Sequence[float]
    hidden_state: tuple[float, float] | None = None


@dataclass(frozen=True)
class CapacitanceTerm:
    """A capacitance term for the integrator.

    Attributes:
        law: compiled with ``scanner.integrator.abi.CAPACITANCE_LAW``.
        parameters: of the law [SI].
    """

    law: Callable[..., Any]
    parameters: Sequence[float]

    def evaluate(self, angle: Array, axis: Axis) -> Array:
        """Return additional capacitance [F] and slope [F/rad] at angles of shape (n,) [rad], shape (2, n)."""
        out = np.empty((2, angle.size))
        _evaluate_capacitance(
            address_of(self.law), _float64(angle), np.asarray(self.parameters, float), nominal_values(axis), out
        )
        return out


class TrajectorySpec(NamedTuple):
    """One motion to integrate.

    Attributes:
        axis: nominal values.
        start: angle [rad] and rate [rad/s].
        torques, capacitances: terms, at most ``MAX_TERMS_PER_STAGE`` of each.
    """

    axis: Axis
    start: tuple[float, float]
    torques: Sequence[TorqueTerm] = ()
    capacitances: Sequence[CapacitanceTerm] = ()


def integrate(
    axis: Axis,
    start: tuple[float, float],
    voltage: Array,
    step: float,
    t0: float = 0.0,
    torques: Sequence[TorqueTerm] = (),
    capacitances: Sequence[CapacitanceTerm] = (),
    other_angle: Array | None = None,
) -> tuple[Array, Array]:
    """Integrate the equation of motion of one axis by the Runge-Kutta method of order 4.

    Args:
        axis: nominal values.
        start: angle [rad] and rate [rad/s].
        voltage: drive, shape (n, 3) [V]; step, t0, other_angle: as in :func:`integrate_batch`.
        torques, capacitances: terms, at most ``MAX_TERMS_PER_STAGE`` of each.

    Returns:
        (angle [rad], rate [rad/s]), each of shape (n + 1,), the start included.

    Raises:
        BadInput: more terms than ``MAX_TERMS_PER_STAGE``.
        ValueError: drives of other lengths.
        DeviceInvalid: the device states no mechanics of the axis.
    """
    return integrate_batch([TrajectorySpec(axis, start, torques, capacitances)], [voltage], step, t0, other_angle)[0]


def integrate_batch(
    specs: Sequence[TrajectorySpec],
    voltages: Sequence[Array],
    step: float,
    t0: float = 0.0,
    other_angle: Array | None = None,
) -> list[tuple[Array, Array]]:
    """Integrate up to ``LANES`` motions with the same laws, whose numbers and drives may differ.

    Args:
        specs: of the motions. The kinds of drive and the laws of the first one hold for all.
        voltages: drive of each motion at the start, middle and end of every step, shape (n, 3) [V]. A jump between
            two steps is represented exactly.
        step: length of a step [s].
        t0: time of the start [s].
        other_angle: angle of the other axis, shape (n, 3) [rad]; zero by default.

    Returns:
        For each motion what :func:`integrate` returns. Raises as that.
    """
    steps, motions, first = len(voltages[0]), len(specs), specs[0]
    if motions > LANES:
        raise ValueError(f"{motions} motions, at most {LANES} are integrated together")
    # An array each, so that a caller who keeps one motion does not keep the memory of all.
    results = [(np.empty(steps + 1), np.empty(steps + 1)) for _ in specs]
    start = np.zeros((motions, 2 + 2 * MAX_TERMS_PER_STAGE))
    for row, spec in zip(start, specs, strict=True):
        row[:2] = spec.start
        for i, torque in enumerate(spec.torques):
            row[2 + 2 * i : 4 + 2 * i] = torque.hidden_state or 0.0
    drive = first.axis.drive
    electrostatic = (drive is None or drive.kind == "electrostatic") and first.axis.capacitance is not None
    laws = (
        _lane_laws([torque.law for torque in first.torques]),
        _parameter_table([[torque.parameters for torque in spec.torques] for spec in specs]),
        len(first.torques),
        _lane_laws([term.law for term in first.capacitances]),
        _parameter_table([[term.parameters for term in spec.capacitances] for spec in specs]),
        len(first.capacitances),
        np.array([nominal_values(spec.axis) for spec in specs]),
        float(electrostatic),
        2 * len(first.torques) if any(torque.hidden_state for torque in first.torques) else 0,
    )
    others = np.zeros((steps, 3)) if other_angle is None else _float64(other_angle)
    width = _LANES_PER_VECTOR * -(-motions // _LANES_PER_VECTOR)
    drives = [_float64(voltage) for voltage in voltages]
    if len(drives) != motions or any(drive.shape != others.shape for drive in drives):
        raise ValueError(f"drives of shapes {[drive.shape for drive in drives]} for {motions} motions of {steps} steps")
    of_drives = np.array([drive.ctypes.data for drive in drives])
    if np.all(of_drives == of_drives[0]):
        of_drives = of_drives[:1]
    of_results = np.array([[array.ctypes.data for array in result] for result in results])
    run_kernel(start, of_drives, others, float(t0), float(step), laws, width, of_results)
    return results


def _float64(values: Array) -> Array:
    return np.ascontiguousarray(values, np.float64)


def _lane_laws(laws: list[Callable[..., Any]]) -> tuple[FunctionAddress, ...]:
    if len(laws) > MAX_TERMS_PER_STAGE:
        what = (
            f"{len(laws)} effects act on the torque or the capacitance of one axis, at most {MAX_TERMS_PER_STAGE} can"
        )
        raise BadInput(what, hint="state fewer terms in the device")
    return tuple(map(in_all_lanes, laws)) + (address_of(no_law),) * (MAX_TERMS_PER_STAGE - len(laws))


def _parameter_table(parameters: Sequence[Sequence[Sequence[float]]]) -> Array:
    """Parameters by term, place and lane, shape (``MAX_TERMS_PER_STAGE``, largest number of any term, ``LANES``).

    Lanes without a motion have the parameters of the last one.
    """
    most = max([1, *(len(row) for rows in parameters for row in rows)])
    table = np.zeros((MAX_TERMS_PER_STAGE, most, LANES))
    for lane in range(LANES):
        for i, row in enumerate(parameters[min(lane, len(parameters) - 1)]):
            table[i, : len(row), lane] = row
    return table
