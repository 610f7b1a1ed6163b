"""LabVIEW Measurement files (.lvm): a header for the file, a header for its segment, and a text table."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from datetime import datetime
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.io.readers.contents import (
    Contents,
    Variable,
    agree_on_clock,
    map_blocks,
    normalise_unit,
    rate_from_step,
    unique_names,
)
from recon.io.readers.reader import Reader
from recon.io.readers.text_table import parse_number, parse_number_blocks, read_lines, split_fields
from scanner.errors import BadInput
from scanner.wording import counted

MAGIC = "LabVIEW Measurement"
END_OF_HEADER = "***End_of_Header***"
SEPARATOR_NAMES = {"Tab": "\t", "Comma": ","}
"""Separators as the header names them."""
MAX_HEADER_LINES = 1000
"""Limit of the lines of one header, so that a file without an end of header is refused early."""

Head = Mapping[str, list[str]]


def read_lvm(path: Path) -> Contents:
    """Channels of an .lvm file of one segment; time 0 is the earliest start of a channel.

    A channel slower than the others fills only the first rows of each block; the empty rows are removed.

    Raises:
        BadInput: no such file, another format, several segments, or a line that is no row of the table.
    """
    lines = read_lines(path)
    if not next(lines, "").startswith(MAGIC):
        raise BadInput("is not a LabVIEW Measurement file", file=path, hint="name its format in the mapping")
    file_head, used = _head(lines, "\t", path)
    separator = SEPARATOR_NAMES.get(_first(file_head, "Separator"), "\t")
    decimal = _first(file_head, "Decimal_Separator") or "."
    segment, used_too = _head(lines, separator, path)
    names = split_fields(next(lines, ""), separator)
    count = int(_numbers([_first(segment, "Channels")], ".")[0])
    columns = _columns(names, _first(file_head, "X_Columns"), count, path)
    wanted = sorted({column for pair in columns for column in pair if column is not None})
    line = used + used_too + 3
    table = map_blocks(parse_number_blocks(_one_segment(lines, path), path, separator, wanted, line, decimal), path)
    at = {column: index for index, column in enumerate(wanted)}
    starts = _starts(segment, file_head, count, decimal)
    variables = {}
    for index, name in enumerate(unique_names(names[column] for _, column in columns)):
        x, column = columns[index]
        times = None if x is None else table[:, at[x]]
        variables[name] = _variable(table[:, at[column]], times, segment, index, starts[index], decimal)
    return Contents("LabVIEW Measurement", variables, _about(file_head))


def _head(lines: Iterator[str], separator: str, path: Path) -> tuple[Head, int]:
    """Keys and values of a header, and the number of its lines."""
    head: dict[str, list[str]] = {}
    for used, line in enumerate(lines, 1):
        key, *values = split_fields(line, separator)
        if key == END_OF_HEADER:
            return head, used
        if used > MAX_HEADER_LINES:
            break
        head[key] = values
    raise BadInput(f"a header is not closed by {END_OF_HEADER}", file=path, hint="the file may be cut; copy it again")


def _one_segment(lines: Iterable[str], path: Path) -> Iterator[str]:
    for line in lines:
        if line.startswith(END_OF_HEADER):
            raise BadInput("holds more than one segment", file=path, hint="save each segment to a separate file")
        yield line


def _columns(names: list[str], kind: str, count: int, path: Path) -> list[tuple[int | None, int]]:
    """Columns of each channel's times and values; ``kind`` is the header's X_Columns: One, Multi or No."""
    if not 1 <= count <= len(names):
        raise BadInput(f"says Channels {count} over {counted(len(names), 'column')}", file=path, hint="export it again")
    layout: list[tuple[int | None, int]]
    if kind == "Multi":
        layout = [(2 * index, 2 * index + 1) for index in range(count)]
    else:  # with "No", the column of times is there, empty
        layout = [(None if kind == "No" else 0, index + 1) for index in range(count)]
    if layout[-1][1] >= len(names):
        raise BadInput(
            f"has {counted(len(names), 'column')} for {counted(count, 'channel')}", file=path, hint="export it again"
        )
    return layout


def _variable(
    values: NDArray[Any], times: NDArray[Any] | None, head: Head, index: int, start: float, decimal: str
) -> Variable:
    samples, step = (_numbers(head.get(key, []), decimal) for key in ("Samples", "Delta_X"))
    longest, size = max(samples, default=0), samples[index] if index < len(samples) else 0
    rate = rate_from_step(step[index]) if index < len(step) else None
    note = ""
    if 1 <= size < longest:
        values = values[np.arange(len(values)) % int(longest) < size]
        note = f"{size:g} of each {longest:g} rows"
    elif times is not None:
        rate, _, note = agree_on_clock(times, rate)
    x_unit = (head.get("X_Dimension") or ["Time"] * (index + 1))[index : index + 1]
    if x_unit != ["Time"]:
        rate, note = None, f"its X is {''.join(x_unit) or 'unnamed'}, not Time"
    units = head.get("Y_Unit_Label", [])
    unit = normalise_unit(units[index]) if index < len(units) else None
    return Variable(values, unit, rate, None if rate is None else start, note)


def _numbers(texts: Iterable[str], decimal: str) -> list[float]:
    """Numbers of a header's line; 0 for text that is not a positive number."""
    numbers = (parse_number(text, decimal) for text in texts)
    return [number if number is not None and 0 < number < np.inf else 0.0 for number in numbers]


def _starts(segment: Head, file_head: Head, count: int, decimal: str) -> list[float]:
    """X0 of each channel plus its time of day after the earliest one [s]."""
    zeros = [parse_number(text, decimal) or 0.0 for text in segment.get("X0", [])][:count]
    zeros = [zero if np.isfinite(zero) else 0.0 for zero in zeros] + [0.0] * (count - len(zeros))
    starts: list[Decimal] = []
    if _first(file_head, "Time_Pref") == "Absolute":
        days, times = segment.get("Date", [])[:count], segment.get("Time", [])[:count]
        starts = [moment for pair in zip(days, times, strict=False) if (moment := _moment(*pair)) is not None]
    if len(starts) != count:
        return zeros
    return [zero + float(moment - min(starts)) for zero, moment in zip(zeros, starts, strict=True)]


def _moment(day: str, time: str) -> Decimal | None:
    """Date and time in seconds, with all digits that LabVIEW writes; None if it is no date and time."""
    try:
        hours, minutes, seconds = time.replace(",", ".").split(":")
        ordinal = datetime.strptime(day, "%Y/%m/%d").toordinal()
        moment = Decimal(86400 * ordinal + 3600 * int(hours) + 60 * int(minutes)) + Decimal(seconds)
    except (ValueError, InvalidOperation):
        return None
    return moment if moment.is_finite() else None


def _about(head: Head) -> dict[str, str]:
    day, time = _first(head, "Date").replace("/", "-"), _first(head, "Time")[:15].replace(",", ".")
    return {"acquired": f"{day}T{time}"} if day and time else {}


def _first(head: Head, key: str) -> str:
    return (head.get(key) or [""])[0]


READER = Reader("lvm", read_lvm, beginnings=(MAGIC.encode(),), suffixes=(".lvm",))
