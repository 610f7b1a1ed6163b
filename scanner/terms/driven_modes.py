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
from scanner.device_toml import FINITE, POSITIVE, checked_number, checked_numbers
from scanner.errors import DeviceInvalid
from scanner.stages import MotionSensor
from scanner.terms.term import Parameter, SignalContext, Term

EFFECT = "driven-modes"
LISTS = {"frequency": POSITIVE, "quality": POSITIVE, "gain": FINITE}
"""Lists that every table has, with the condition on their numbers."""

GAIN_RATE = "gain_rate"
EQUATION = "y = y_nominal + Σ q_i + direct V,  q_i'' + (ω_i/Q_i) q_i' + ω_i² q_i = a_i V + h_i V'/ω_i"
SOURCE = "Ewins, Modal Testing, Research Studies Press (2000), section 4.3: residues and residual terms"

CHANNELS = {"sense": None, "angle": 0, "velocity": 1, "acceleration": 2}
"""Channels that contain the modes, and the time derivative that each holds; the sense signal has its readout's."""

MAX_KEPT_SAMPLES = 1_000_000
"""Length of a recording up to which the last sums of modes are kept: 16 MB each at this length. A diagnosis fits fewer
samples, and evaluates them thousands of times."""


@lru_cache(maxsize=256)
def _transition(frequency: float, quality: float, step: float) -> Array:
    """Exact step of (q, q') of a mode under a voltage that is linear in between, shape (2, 4).

    Its columns are the effect of q, of q', of the voltage at the start and of that at the end.
    """
    from scipy.linalg import expm

    rate = 2.0 * np.pi * frequency
    system = np.zeros((4, 4))
    system[0, 1], system[1, 0], system[1, 1], system[1, 2] = step, -(rate**2) * step, -rate / quality * step, step
    system[2, 3] = 1.0
    whole = expm(system)
    return np.column_stack([whole[:2, :2], whole[:2, 2] - whole[:2, 3], whole[:2, 3]])


@register_jitable(forceinline=True)
def _advance(q, rate, before, after, step):  # type: ignore[no-untyped-def]
    return (
        step[0, 0] * q + step[0, 1] * rate + step[0, 2] * before + step[0, 3] * after,
        step[1, 0] * q + step[1, 1] * rate + step[1, 2] * before + step[1, 3] * after,
    )


@njit(cache=True, nogil=True)
def _run(voltage, step, q, rate):  # type: ignore[no-untyped-def]
    out = np.empty((2, voltage.size))
    for i in range(voltage.size):
        if i:
            q, rate = _advance(q, rate, voltage[i - 1], voltage[i], step)
        out[0, i], out[1, i] = q, rate
    return out


@njit(cache=True, nogil=True)
def _sum_of_modes(voltage, slope, steps, squares, dampings, gains, gain_rates, order):  # type: ignore[no-untyped-def]
    """Sum of the time derivatives ``order`` of all modes times their gains, and of the next ones times ``gain_rates``.

    The modes advance together: the steps of one wait for each other, those of different modes do not.
    """
    total = np.zeros(voltage.size)
    q, rate = voltage[0] / squares, np.zeros(squares.size)
    for i in range(voltage.size):
        value = 0.0
        for m in range(squares.size):
            if i:
                q[m], rate[m] = _advance(q[m], rate[m], voltage[i - 1], voltage[i], steps[m])
            acceleration = voltage[i] - dampings[m] * rate[m] - squares[m] * q[m]
            if order == 0:
                value += gains[m] * q[m] + gain_rates[m] * rate[m]
            elif order == 1:
                value += gains[m] * rate[m] + gain_rates[m] * acceleration
            else:
                jerk = slope[i] - dampings[m] * acceleration - squares[m] * rate[m]
                value += gains[m] * acceleration + gain_rates[m] * jerk
        total[i] = value
    return total


def mode_response(voltage: Array, frequency: float, quality: float, step: float) -> Array:
    """Response of a mode of unit gain and its first three time derivatives, shape (4, n) [rad/s^n].

    Args:
        voltage: at the samples, shape (n,) [V].
        frequency: of the mode [Hz].
        step: between samples [s].
    """
    rate = 2.0 * np.pi * frequency
    q, velocity = _run(np.ascontiguousarray(voltage), _transition(frequency, quality, step), voltage[0] / rate**2, 0.0)
    acceleration = voltage - rate / quality * velocity - rate**2 * q
    return np.stack(
        [q, velocity, acceleration, np.gradient(voltage, step) - rate / quality * acceleration - rate**2 * velocity]
    )


def _motion(values: Sequence[float], context: SignalContext, order: int) -> Array:
    """Sum of all modes, in the time derivative ``order``, shape (n,)."""
    voltage = np.ascontiguousarray(context.voltage, float)
    sum_of = _last_sums if voltage.size <= MAX_KEPT_SAMPLES else _last_sums.__wrapped__
    return np.asarray(sum_of(voltage.tobytes(), context.step, order, tuple(values)))


@lru_cache(maxsize=4)
def _last_sums(voltage: bytes, step: float, order: int, values: Sequence[float]) -> Array:
    """The sum of all modes under a voltage. A fit of other parts of the device needs the same one at every step."""
    volts = np.frombuffer(voltage)
    frequency, quality, gain, gain_rate = np.reshape(values[2:], (int(values[0]), 4)).T
    rate, slope = 2.0 * np.pi * frequency, np.gradient(volts, step)
    steps = np.array([_transition(f, q, step) for f, q in zip(frequency, quality, strict=True)])
    steps = steps.reshape(-1, 2, 4)
    total = _sum_of_modes(volts, slope, steps, rate**2, rate / quality, gain, gain_rate / rate, order)
    total.flags.writeable = False
    return np.asarray(total)


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
        DeviceInvalid: a list is missing or of another length, a value is no finite number, a frequency or quality is
            not positive, or the readout is not a sensor of motion.
    """
    if missing := [key for key in LISTS if key not in table]:
        raise DeviceInvalid(f"lacks {missing[0]}", hint=f"it needs {', '.join(LISTS)}")
    columns = [checked_numbers(table[key], must["must"], key) for key, must in LISTS.items()]
    columns.append(checked_numbers(table.get(GAIN_RATE, (0.0,) * len(columns[0])), FINITE["must"], GAIN_RATE))
    if len({len(column) for column in columns}) > 1:
        raise DeviceInvalid("has lists of different lengths", hint="state one frequency, quality and gain a mode")
    direct = checked_number(table.get("direct", 0.0), FINITE["must"], "direct")
    if axis.readout is not None and not isinstance(axis.readout, MotionSensor):
        hint = "use a readout of kind position, velocity or acceleration, or the term second-mode"
        raise DeviceInvalid("acts on sensors of motion only", hint=hint)
    values = (float(len(columns[0])), direct, *np.transpose(columns).ravel().tolist())
    names = tuple(Parameter(f"p{i}", "SI", lambda scales: 0.0) for i in range(len(values)))
    channels = [channel for channel in CHANNELS if channel != "sense" or axis.readout is not None]
    return [
        (Term(EFFECT, "mechanics", EQUATION, names, SOURCE, channels=(each,), output=_LAWS[each]), values, each)
        for each in channels
    ]
