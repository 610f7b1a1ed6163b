"""Names and units of columns as people and instruments write them: ``CH1 (V)``, ``Time [s]``, a line of units below."""

from __future__ import annotations

import re
from collections.abc import Sequence

from recon.io.readers.contents import UNIT_SPELLINGS

TIME_UNITS = {
    "s": 1.0, "sec": 1.0, "secs": 1.0, "second": 1.0, "seconds": 1.0,
    "ms": 1e-3, "millisecond": 1e-3, "milliseconds": 1e-3,
    "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "microsecond": 1e-6, "microseconds": 1e-6,
    "ns": 1e-9, "nanosecond": 1e-9, "nanoseconds": 1e-9,
}  # fmt: skip
"""Seconds of a unit of time, by its spelling in lower case."""

TIME_NAMES = ("t", "time", "times", "time stamp", "timestamp", "x-axis", "zeit", "second", "seconds", "sec")
"""Names of a column of times in lower case. One with a unit of time is the clock; without one it may be."""

OTHER_UNITS = (
    "hz",
    "counts",
    "count",
    "a.u.",
    "au",
    "arb",
    "nm",
    "um",
    "µm",
    "w",
    "mw",
    "uw",
    "µw",
    "k",
    "c",
    "ma",
    "ua",
)
"""Further units that a line of units may hold, in lower case."""

KNOWN_UNITS = {*UNIT_SPELLINGS, *TIME_UNITS, *OTHER_UNITS}
"""All units that a line of units may hold, in lower case."""

_LABELLED = re.compile(r"^(?P<name>.*\S)\s*[(\[](?P<unit>[^()\[\]]*)[)\]]$")


def split_label(label: str) -> tuple[str, str]:
    """Name and unit of a heading such as ``CH1 (V)`` or ``Time [s]``; an empty unit where it states none."""
    match = _LABELLED.match(label.strip())
    return (match["name"], match["unit"].strip()) if match else (label.strip(), "")


def is_unit_line(fields: Sequence[str]) -> bool:
    """Whether every field of a line is a unit, bare or in brackets, or empty, and one at least is a unit."""
    bare = [field.strip().strip("()[]").strip().lower() for field in fields]
    return any(bare) and all(not each or each in KNOWN_UNITS for each in bare)


def name_columns(head: Sequence[Sequence[str]], width: int) -> tuple[list[str], list[str]]:
    """Names and units of the columns from the lines above them.

    Args:
        head: fields of these lines; the last ones count.
        width: number of columns.
    """
    lines = [[*line, *[""] * width][:width] for line in head if any(line)]
    if not lines:
        return [""] * width, [""] * width
    below: list[str] | None = None
    if is_unit_line(lines[-1]):
        below = [field.strip("()[] ") for field in lines.pop()]
    names, units = zip(*(split_label(label) for label in (lines[-1] if lines else below or [""] * width)), strict=True)
    units = tuple(unit or (below[at] if below else "") for at, unit in enumerate(units))
    return list(names), list(units)


def find_time_column(names: Sequence[str], units: Sequence[str]) -> int | None:
    """Index of the one column that is unmistakably a clock: named as a time, in a unit of time; else None."""
    found = [
        at
        for at, (name, unit) in enumerate(zip(names, units, strict=True))
        if name.strip().lower() in TIME_NAMES and unit.strip().lower() in TIME_UNITS
    ]
    return found[0] if len(found) == 1 else None
