"""A law without a name, as a diagnosis measured it: a polynomial of the stage's variables with the range it holds in.

A device file states it under ``[x.terms.measured-law]``:

    stage = "mechanics"                  # adds to the torque of the spring and damper [N m]
    variables = ["angle", "rate"]        # [rad, rad/s]
    centre = [0.0, 0.0]                  # the polynomial's origin
    lower = [-0.2, -3000.0]              # the range in which the law was measured
    upper = [0.2, 3000.0]
    powers = [[2, 0], [3, 0]]            # of (angle - centre) and (rate - centre), one pair a coefficient
    coefficients = [1e-9, 2e-9]          # SI units: N m / (rad^i (rad/s)^j)
    coefficients_sd = [1e-11, 3e-11]     # standard deviations; no law uses them

A law of one variable may also have a table, straight between its knots, that adds to the polynomial:

    knots = [-0.2, 0.0, 0.2]             # of the variable
    knot_values = [1e-3, 0.0, -2e-3]
    knot_values_sd = [1e-4, 1e-4, 1e-4]

Other stages have one variable. ``readout`` adds to the signal [V] a law of the signal [V], ``drive`` adds to the
voltage a law of the voltage [V], ``optics`` adds to the reference angle a law of the angle [rad]. The range of two
variables is the ellipse between ``lower`` and ``upper``: an oscillation reaches its largest angle and its largest rate
at different times, so no sample was measured in the corners. Beyond its range a law continues along the radius with the
slope at the edge, and so does a table beyond its knots. It is not part of the catalogue that a diagnosis searches.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numba import njit

from scanner.arrays import Array
from scanner.device_toml import FINITE, INDEX, checked_numbers
from scanner.errors import DeviceInvalid
from scanner.integrator.abi import TORQUE_LAW
from scanner.terms.term import Parameter, SignalContext, Term

EFFECT = "measured-law"
VARIABLES = {
    "mechanics": ("angle", "rate"),
    "readout": ("signal",),
    "drive": ("voltage",),
    "optics": ("angle",),
}
"""Variables of a law by its stage."""


@njit(cache=True, nogil=True)
def polynomial(p, first, second):  # type: ignore[no-untyped-def]
    """Value of a packed law at two variables: a polynomial within its range, straight along the radius beyond it.

    ``p`` holds the number of coefficients; centre, lower and upper end, each of both variables; for each coefficient
    the powers of both variables and its value; and the knots of a table and its values, which are not used here.
    """
    middle_a, middle_b = 0.5 * (p[3] + p[5]), 0.5 * (p[4] + p[6])
    half_a, half_b = 0.5 * (p[5] - p[3]), 0.5 * (p[6] - p[4])
    square = 0.0
    if half_a > 0.0:
        square += ((first - middle_a) / half_a) ** 2
    if half_b > 0.0:
        square += ((second - middle_b) / half_b) ** 2
    radius = np.sqrt(square)
    a, b = first, second
    if radius > 1.0:
        a, b = middle_a + (first - middle_a) / radius, middle_b + (second - middle_b) / radius
    x, y = a - p[1], b - p[2]
    value, slope_a, slope_b = 0.0, 0.0, 0.0
    for n in range(int(p[0])):
        i, j, c = int(p[7 + 3 * n]), int(p[8 + 3 * n]), p[9 + 3 * n]
        value += c * x**i * y**j
        if i > 0:
            slope_a += c * i * x ** (i - 1) * y**j
        if j > 0:
            slope_b += c * j * x**i * y ** (j - 1)
    return value + slope_a * (first - a) + slope_b * (second - b)


@njit(TORQUE_LAW, cache=True)
def torque(t, theta, omega, other, volt, z0, z1, p, nominal):  # type: ignore[no-untyped-def]
    return -polynomial(p, theta, omega), 0.0, 0.0


@njit(cache=True, nogil=True)
def _along(p, values):  # type: ignore[no-untyped-def]
    out = np.empty_like(values)
    for i in range(values.size):
        out[i] = polynomial(p, values[i], p[2])
    return out


def added(values: Array, p: Sequence[float]) -> Array:
    """What a law of one variable adds at ``values``, of their shape."""
    polynomial_part = _along(np.asarray(p, float), np.ascontiguousarray(values, float).ravel()).reshape(values.shape)
    knots, knot_values = np.reshape(p[7 + 3 * int(p[0]) :], (2, -1))
    return np.asarray(polynomial_part + _straight_between(values, knots, knot_values))


def _straight_between(values: Array, knots: Array, knot_values: Array) -> Array:
    """Piecewise linear interpolation, continued with the slope of the first and the last piece; 0 without knots."""
    if not knots.size:
        return np.zeros(np.shape(values))
    slopes = np.diff(knot_values) / np.diff(knots)
    below, above = np.minimum(values - knots[0], 0.0), np.maximum(values - knots[-1], 0.0)
    return np.asarray(np.interp(values, knots, knot_values) + slopes[0] * below + slopes[-1] * above)


def _output(signal: Array, p: Sequence[float], context: SignalContext) -> Array:
    return signal + added(signal, p)


def _voltage(voltage: Array, p: Sequence[float], context: SignalContext) -> Array:
    return voltage + added(voltage, p)


_LAWS: dict[str, dict[str, Any]] = {
    "mechanics": {"torque": torque},
    "readout": {"output": _output},
    "drive": {"voltage": _voltage},
    "optics": {"output": _output, "channels": ("angle",)},
}


def measured_law(table: Mapping[str, Any]) -> tuple[Term, tuple[float, ...]]:
    """Return the term that a table of a device file states, and its packed values.

    Raises:
        DeviceInvalid: a stage that has no measured law, a key missing, a value that is no list of finite numbers, lists
            of different lengths, an upper end below the lower one, or a table that is not ascending, has fewer than
            two knots, or is of two variables.
    """
    stage = table.get("stage")
    if not isinstance(stage, str) or stage not in VARIABLES:
        raise DeviceInvalid(f"stage {stage!r} is unknown", hint=f"stages with a measured law: {', '.join(VARIABLES)}")
    needed = ("centre", "lower", "upper", "powers", "coefficients")
    if missing := [key for key in needed if key not in table]:
        raise DeviceInvalid(f"lacks {missing[0]}", hint=f"it needs {', '.join(needed)}")
    width = len(VARIABLES[stage])
    packed = _packed_range(table, width) + _packed_polynomial(table, VARIABLES[stage])
    packed = [float(len(table["coefficients"])), *packed, *_packed_table(table, width)]
    names = [Parameter(f"p{i}", "SI", lambda scales: 0.0) for i in range(len(packed))]
    return Term(EFFECT, stage, "law as measured, no name", tuple(names), "a diagnosis", **_LAWS[stage]), tuple(packed)


def _packed_range(table: Mapping[str, Any], width: int) -> list[float]:
    """Centre, lower and upper end, each of two variables."""
    keys = ("centre", "lower", "upper")
    centre, lower, upper = (checked_numbers(table[key], FINITE["must"], key, width) for key in keys)
    if any(low > high for low, high in zip(lower, upper, strict=True)):
        what = f"is {list(upper)} and must not be below lower, {list(lower)}"
        raise DeviceInvalid(what, channel="upper", hint="state the range in which the law was measured")
    return [number for each in (centre, lower, upper) for number in [*each, 0.0][:2]]


def _packed_polynomial(table: Mapping[str, Any], variables: Sequence[str]) -> list[float]:
    """For each coefficient the powers of two variables and its value."""
    coefficients, powers = checked_numbers(table["coefficients"], FINITE["must"], "coefficients"), table["powers"]
    if not isinstance(powers, (list, tuple)) or len(powers) != len(coefficients):
        what = f"is {powers!r} and must be a list with one list of powers a coefficient"
        raise DeviceInvalid(what, channel="powers", hint=f"each holds the power of {' and of '.join(variables)}")
    each_power = [checked_numbers(each, INDEX["must"], "powers", len(variables)) for each in powers]
    rows = zip(each_power, coefficients, strict=True)
    return [number for power, coefficient in rows for number in (*[*power, 0.0][:2], coefficient)]


def _packed_table(table: Mapping[str, Any], width: int) -> list[float]:
    """The knots of a law and its values at them; empty where it has no table."""
    knots, values = (checked_numbers(table.get(key, ()), FINITE["must"], key) for key in ("knots", "knot_values"))
    if not knots and not values:
        return []
    if width > 1 or len(knots) != len(values) or len(knots) < 2 or not np.all(np.diff(knots) > 0.0):
        hint = "a law of one variable has two or more ascending knots, and one of knot_values for each"
        raise DeviceInvalid("has a table that cannot be used", hint=hint)
    return [*knots, *values]


def beyond(table: Mapping[str, Any], values: Sequence[Array]) -> float:
    """Fraction of samples that lie beyond a law's range or are not finite.

    Args:
        values: of each of its variables, shape (n,) each.
    """
    square = np.zeros(np.shape(values[0]))
    for lower, upper, each in zip(table["lower"], table["upper"], values, strict=True):
        half = 0.5 * (upper - lower)
        if half > 0.0:
            square += ((np.asarray(each) - lower) / half - 1.0) ** 2
    return float(np.mean(~(square <= (1.0 + 1e-9) ** 2)))
