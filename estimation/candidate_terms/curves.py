"""Curves: discrepancy terms of an error that depends on the present value of one signal alone.

A table beside a polynomial follows a dead zone, a fold or a gain that differs by sign, which no polynomial does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from scanner.arrays import Array
from scanner.terms import Parameter, SignalContext, Term

CURVE_INTERVALS = (16, 32, 64)
"""Numbers of intervals of the table in a curve of drive or readout, at each level of its refinement. Four standard
deviations to either side, half of one long, resolve a fifth of the range of a sine; an eighth shows kinks as of a dead
zone in a precise signal."""

CURVE_KNOTS = np.linspace(-4.0, 4.0, CURVE_INTERVALS[-1] + 1)
"""Signals, in standard deviations, between which a curve of drive or readout is linear beside a polynomial."""


def _curve_columns() -> list[Array]:
    """The functions that add up to the table of a curve, each level by level, at ``CURVE_KNOTS``.

    Each is 1 at one knot of its level and 0 at the others; knots of a level are midpoints of the level before. With all
    parameters of a further level at 0, the table is as before.
    """
    columns: list[Array] = []
    for level, intervals in enumerate(CURVE_INTERVALS):
        hats = np.eye(intervals + 1)[1::2] if level else np.eye(intervals + 1)
        grid = np.linspace(CURVE_KNOTS[0], CURVE_KNOTS[-1], intervals + 1)
        columns += [np.interp(CURVE_KNOTS, grid, hat) for hat in hats]
    return columns


CURVE_COLUMNS = np.column_stack(_curve_columns())
"""Table of a curve at ``CURVE_KNOTS`` by each of its parameters, shape (knots, parameters)."""


def table_columns(u: Array) -> Array:
    """Table of a curve at signals ``u`` [standard deviations] by each of its parameters, shape (n, parameters)."""
    return np.stack([np.interp(u, CURVE_KNOTS, column) for column in CURVE_COLUMNS.T], axis=1)


CURVE_NAMES = tuple(f"s{i}" for i in range(CURVE_COLUMNS.shape[1]))
"""Names of the parameters of the table of a curve, of the first level first."""

SOURCE = "discrepancy term (Kennedy & O'Hagan 2001): a piecewise linear function"


def _readout_curve(signal: Array, p: Sequence[float], context: SignalContext) -> Array:
    """Readout with an error that depends on the signal alone."""
    return signal + p[0] * _curve((signal - signal.mean()) / p[0], p[1:])


def _drive_curve(voltage: Array, p: Sequence[float], context: SignalContext) -> Array:
    """Drive voltage with an error that depends on the voltage alone."""
    return voltage + p[0] * _curve((voltage - context.raw_voltage.mean()) / p[0], p[1:])


def _curve(u: Array, p: Sequence[float]) -> Array:
    """A cubic polynomial without constant and slope, and a table."""
    table = CURVE_COLUMNS[:, : len(p) - 2] @ np.asarray(p[2:])
    return np.asarray(u * u * (p[0] + p[1] * u) + np.interp(u, CURVE_KNOTS, table))


_CURVE_PARAMETERS = (
    *(Parameter(name, "1", lambda s: 0.04) for name in ("c2", "c3")),
    *(Parameter(name, "1", lambda s: 0.02) for name in CURVE_NAMES),
)
_COARSE_CURVE = _CURVE_PARAMETERS[: 2 + CURVE_INTERVALS[0] + 1]

CURVE_TERMS: dict[str, Term] = {
    term.effect: term
    for term in (
        Term(
            "free-readout-curve", "readout", "y + g(y)",
            (Parameter("size", "V", lambda s: s.sense_rms, kind="fixed"), *_COARSE_CURVE),
            SOURCE, output=_readout_curve,
        ),
        Term(
            "free-drive-curve", "drive", "V + g(V)",
            (Parameter("size", "V", lambda s: s.voltage_rms, kind="fixed"), *_COARSE_CURVE),
            SOURCE, voltage=_drive_curve, applies=lambda axis, scales: scales.voltage_rms > 0,
        ),
    )
}  # fmt: skip
"""Further discrepancy terms, each an error that depends on the present value of one signal alone. They may be the
answer where no laws are. Laws are selected without them: beside so much freedom fewer laws are needed, as friction of a
measured pendulum."""

REFINED_CURVES = {
    effect: replace(term, parameters=(*term.parameters[:1], *_CURVE_PARAMETERS)) for effect, term in CURVE_TERMS.items()
}
"""Curves with all levels of their table, for one that is the answer."""
