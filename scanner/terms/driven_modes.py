"""Further modes of the structure that the drive excites directly, and that sensor and beam see beside the mirror's own.

A device file states them under ``[x.terms.driven-modes]``:

    frequency = [3.4, 9.05]      # of every mode [Hz]
    quality = [24.0, 34.0]
    gain = [6e-4, 3.5e-4]        # acceleration of the mode per volt of the drive [rad/s^2 / V]
    gain_rate = [0.0, 0.0]       # the same for the drive's rate over ω_i, optional [rad/s^2 / V]
    direct = 0.0122              # drive in the sense signal, as of all modes below the drive's band, optional [V / V]

Every mode is linear and starts at rest under the drive's first voltage. This is not part of the catalogue that a
diagnosis searches: ``second-mode`` and ``feedthrough`` are its special cases.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numba import njit
from numba.extending import register_jitable

from scanner.arrays import Array
from scanner.device import Axis
from scanner.errors import DeviceInvalid
from scanner.stages import MotionSensor
from scanner.terms.term import Parameter, SignalContext, Term

EFFECT = "driven-modes"
LISTS = ("frequency", "quality", "gain", "gain_rate")
EQUATION = "y = y_nominal + Σ q_i + direct V,  q_i'' + (ω_i/Q_i) q_i' + ω_i² q_i = a_i V + h_i V'/ω_i"
SOURCE = "Ewins, Modal Testing, Research Studies Press (2000), section 4.3: residues and residual terms"

CHANNELS = {"sense": None, "angle": 0, "velocity": 1, "acceleration": 2}
"""Channels that contain the modes, and the time derivative that each holds; the sense signal has its readout's."""


@lru_cache(maxsize=256)
def _transition(frequency: float, quality: float, step: float) -> tuple[Array, Array, Array]:
    """Exact step of (q, q') of a mode under a voltage that is linear in between.

    Returns:
        matrix of the state, shape (2, 2), and the effect of the voltage at the start and at the end, shape (2,) each.
    """
    from scipy.linalg import expm

    rate = 2.0 * np.pi * frequency
    system = np.zeros((4, 4))
    system[0, 1], system[1, 0], system[1, 1], system[1, 2] = step, -(rate**2) * step, -rate / quality * step, step
    system[2, 3] = 1.0
    whole = expm(system)
    return np.ascontiguousarray(whole[:2, :2]), whole[:2, 2] - whole[:2, 3], np.ascontiguousarray(whole[:2, 3])


@register_jitable(forceinline=True)
def _advance(q, rate, before, after, matrix, first, last):  # type: ignore[no-untyped-def]
    return (
        matrix[0, 0] * q + matrix[0, 1] * rate + first[0] * before + last[0] * after,
        matrix[1, 0] * q + matrix[1, 1] * rate + first[1] * before + last[1] * after,
    )


@njit(cache=True, nogil=True)
def _run(voltage, matrix, first, last, q, rate):  # type: ignore[no-untyped-def]
    out = np.empty((2, voltage.size))
    for i in range(voltage.size):
        if i:
            q, rate = _advance(q, rate, voltage[i - 1], voltage[i], matrix, first, last)
        out[0, i], out[1, i] = q, rate
    return out


@njit(cache=True, nogil=True)
def _add_mode(total, voltage, slope, matrix, first, last, square, damping, gain, gain_rate, order):  # type: ignore[no-untyped-def]
    """Add a mode in the time derivative ``order``, and ``gain_rate`` times the next one, without arrays in between."""
    q, rate = voltage[0] / square, 0.0
    for i in range(voltage.size):
        if i:
            q, rate = _advance(q, rate, voltage[i - 1], voltage[i], matrix, first, last)
        acceleration = voltage[i] - damping * rate - square * q
        if order == 0:
            total[i] += gain * q + gain_rate * rate
        elif order == 1:
            total[i] += gain * rate + gain_rate * acceleration
        else:
            total[i] += gain * acceleration + gain_rate * (slope[i] - damping * acceleration - square * rate)


def mode_response(voltage: Array, frequency: float, quality: float, step: float) -> Array:
    """Response of a mode of unit gain and its first three time derivatives, shape (4, n) [rad/s^n].

    Args:
        voltage: at the samples, shape (n,) [V].
        frequency: of the mode [Hz].
        step: between samples [s].
    """
    rate = 2.0 * np.pi * frequency
    q, velocity = _run(np.ascontiguousarray(voltage), *_transition(frequency, quality, step), voltage[0] / rate**2, 0.0)
    acceleration = voltage - rate / quality * velocity - rate**2 * q
    return np.stack(
        [q, velocity, acceleration, np.gradient(voltage, step) - rate / quality * acceleration - rate**2 * velocity]
    )


def _motion(values: Sequence[float], context: SignalContext, order: int) -> Array:
    """Sum of all modes, in the time derivative ``order``, shape (n,)."""
    voltage, step = np.ascontiguousarray(context.voltage), context.step
    total, slope = np.zeros_like(voltage), np.gradient(voltage, step)
    for i in range(int(values[0])):
        frequency, quality, gain, gain_rate = values[2 + 4 * i : 6 + 4 * i]
        rate, transition = 2.0 * np.pi * frequency, _transition(frequency, quality, step)
        _add_mode(total, voltage, slope, *transition, rate**2, rate / quality, gain, gain_rate / rate, order)
    return total


def _sense(signal: Array, p: Sequence[float], context: SignalContext) -> Array:
    readout = context.readout
    assert isinstance(readout, MotionSensor)
    return signal + readout.gain * _motion(p, context, readout.order) + p[1] * context.voltage


def _reference(order: int) -> Any:
    def output(signal: Array, p: Sequence[float], context: SignalContext) -> Array:
        return signal + _motion(p, context, order)

    return output


_LAWS = {channel: _sense if order is None else _reference(order) for channel, order in CHANNELS.items()}


def driven_modes(table: Mapping[str, Any], axis: Axis) -> list[tuple[Term, tuple[float, ...], str]]:
    """Return the term, its packed values and its channel, for every channel that contains the modes of a table.

    Raises:
        DeviceInvalid: a list is missing or of another length, a frequency or quality is not positive, or the readout
            is not a sensor of motion.
    """
    if missing := [key for key in LISTS[:3] if key not in table]:
        raise DeviceInvalid(f"lacks {missing[0]}", channel=EFFECT, hint=f"it needs {', '.join(LISTS[:3])}")
    columns = [np.atleast_1d(np.asarray(table.get(key, np.zeros(len(table["gain"]))), float)) for key in LISTS]
    if len({column.size for column in columns}) > 1:
        hint = "state one frequency, quality and gain a mode"
        raise DeviceInvalid("has lists of different lengths", channel=EFFECT, hint=hint)
    if not np.all(np.concatenate(columns[:2]) > 0.0):
        raise DeviceInvalid("has a mode without frequency or quality", channel=EFFECT, hint="state them above 0")
    if axis.readout is not None and not isinstance(axis.readout, MotionSensor):
        hint = "use a readout of kind position, velocity or acceleration, or the term second-mode"
        raise DeviceInvalid("acts on sensors of motion only", channel=EFFECT, hint=hint)
    values = (float(columns[0].size), float(table.get("direct", 0.0)), *map(float, np.stack(columns, axis=1).ravel()))
    names = tuple(Parameter(f"p{i}", "SI", lambda scales: 0.0) for i in range(len(values)))
    channels = [channel for channel in CHANNELS if channel != "sense" or axis.readout is not None]
    return [
        (Term(EFFECT, "mechanics", EQUATION, names, SOURCE, channels=(each,), output=_LAWS[each]), values, each)
        for each in channels
    ]
