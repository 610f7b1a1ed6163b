"""Where the numbers of a text file begin, and the settings that some programs write above them.

An acquisition program may write its settings as a table of their own: a line of names, a line of values, and below them
the samples, in other columns. The values are then numbers, but no samples.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import pairwise

from recon.io.readers.text_table import count_filled, is_numeric, parse_number, split_fields


def separator_and_mark(line: str) -> tuple[str, str]:
    """Separator and decimal mark of a line of numbers."""
    for separator in ("\t", ";"):
        if separator in line:
            return separator, "," if "," in line else "."
    return (" " if "," not in line and len(line.split()) > 1 else ","), "."


def find_table(lines: Sequence[str]) -> int | None:
    """Index of the first row of the table of samples in the beginning of a file; None if no line has numbers only.

    It is the first line of numbers with no more fields than most of them have, empty ones counted or not. A line of
    numbers above a line without any is no row: that line names other columns.
    """
    rows = {at: line for at, line in enumerate(lines) if _is_row(line)}
    if not rows:
        return None
    fields, filled = ({at: count(_fields(line)) for at, line in rows.items()} for count in (len, count_filled))
    usual = [Counter(counts.values()).most_common(1)[0][0] for counts in (fields, filled)]
    following = dict(pairwise(at for at, line in enumerate(lines) if line.strip()))
    table = (
        at
        for at in rows
        if (fields[at] <= usual[0] or filled[at] <= usual[1]) and not _is_heading(lines[following.get(at, at)])
    )
    return next(table, next(iter(rows)))


def split_settings(lines: Sequence[str]) -> tuple[str, Sequence[str]]:
    """Settings among the lines above a table, as a text, and the lines below them, which name its columns.

    The lines are all of the second kind where none has numbers only. A setting is a value below its name.
    """
    rows = [at for at, line in enumerate(lines) if _is_row(line)]
    settings = []
    for at in rows:
        names, values = (_fields(line) for line in (lines[at - 1] if at else "", lines[at]))
        if len(names) == len(values):
            settings += [f"{name} = {value}" for name, value in zip(names, values, strict=True) if name]
    return ", ".join(settings), lines[rows[-1] + 1 :] if rows else lines


def _is_row(line: str) -> bool:
    return is_numeric(line, *separator_and_mark(line))


def _fields(line: str) -> list[str]:
    return split_fields(line, separator_and_mark(line)[0])


def _is_heading(line: str) -> bool:
    """Whether no field of a line is a number."""
    return all(not field or parse_number(field) is None for field in _fields(line))
