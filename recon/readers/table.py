"""Numbers in text: lines of bounded length, read block by block, with the line named that holds something else."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanner.errors import BadInput

LONGEST_LINE = 1 << 16
LINES = 1 << 14
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(nan|inf(inity)?)", re.IGNORECASE)

Array = NDArray[np.float64]


def lines_of(path: Path) -> Iterator[str]:
    """Lines of a text file, without their ends.

    Raises:
        BadInput: no such file, a line too long for a table, or bytes that no text holds.
    """
    try:
        file = path.open(encoding="utf-8-sig", errors="replace")
    except OSError as error:
        raise BadInput(f"cannot be read: {error.strerror}", file=path, hint="name the instrument's file") from None
    with file:
        for number, line in enumerate(iter(lambda: file.readline(LONGEST_LINE), ""), 1):
            if len(line) == LONGEST_LINE or "\0" in line:
                raise BadInput(f"line {number} is no line of a table", file=path, hint="check the file's format")
            yield line.rstrip("\r\n")


def fields_of(line: str, separator: str) -> list[str]:
    """A line's fields without blanks and quotes around them."""
    return [part.strip().strip('"').strip() for part in line.split(separator)]


def number_of(text: str, decimal: str = ".") -> float | None:
    """The number that ``text`` is, None where it is none; nothing is not a number (nan)."""
    text = text.strip().strip('"').strip()
    if not text:
        return float("nan")
    text = text.replace(decimal, ".") if decimal != "." else text
    return float(text) if _NUMBER.fullmatch(text) else None


def is_numeric(line: str, separator: str, decimal: str = ".") -> bool:
    """Whether a line holds numbers and blanks, and at least one number."""
    numbers = [number_of(part, decimal) for part in line.split(separator)]
    return None not in numbers and bool(line.replace(separator, "").strip())


def number_blocks(
    lines: Iterable[str], path: Path, separator: str, columns: Sequence[int], line: int, decimal: str = "."
) -> Iterator[Array]:
    """The numbers of some columns, in blocks (n, columns); a blank field is nan, a blank line is passed over.

    Args:
        lines: to be read; the first is number ``line`` of the file, for messages.
        columns: which, from 0.
        decimal: the mark before the fraction.

    Raises:
        BadInput: a field that is no number, or a line that ends before its last column.
    """
    lines = iter(lines)
    while block := list(islice(lines, LINES)):
        try:
            if decimal != "." or not all(block):
                raise ValueError
            yield np.loadtxt(block, delimiter=separator, usecols=columns, ndmin=2, comments=None)
        except (ValueError, IndexError):  # blank fields, quotes, or something wrong: slower, and by line
            rows = ((line + at, text) for at, text in enumerate(block) if text.strip())
            numbers = [_row(text, at, path, separator, columns, decimal) for at, text in rows]
            if numbers:
                yield np.array(numbers)
        line += len(block)


def _row(text: str, line: int, path: Path, separator: str, columns: Sequence[int], decimal: str) -> list[float]:
    parts = text.split(separator)
    if len(parts) <= max(columns):
        what = f"line {line} ends after {len(parts)} of {max(columns) + 1} columns"
        raise BadInput(what, file=path, hint="the file may be cut; export it again")
    numbers = [number_of(parts[column], decimal) for column in columns]
    if None in numbers:
        wrong = parts[columns[numbers.index(None)]][:40]
        raise BadInput(f"line {line}: {wrong!r} is no number", file=path, hint="repair or remove the line")
    return numbers  # type: ignore[return-value]
