"""Tables of numbers in text files, read block by block; errors name the line."""

from __future__ import annotations

import csv
import re
from codecs import getincrementaldecoder
from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path

import numpy as np

from scanner.arrays import Array
from scanner.errors import BadInput
from scanner.wording import counted

MAX_LINE_CHARACTERS = 1 << 16
"""Limit of a line, which keeps a binary file without line ends out of memory."""

UTF_16_MARKS = (b"\xff\xfe", b"\xfe\xff")
"""Byte order marks of the text that Excel saves as "Unicode text"."""

LINES_PER_BLOCK = 1 << 14
"""Lines parsed at a time: many enough for numpy's parser to be fast, few enough to bound memory."""

BEGINNING_BYTES = 1 << 16
"""Bytes of a file by which its encoding is found; the names and units of a table are within them."""

ONE_MARK_HINT = "write numbers with a decimal point, without marks between thousands"
"""What to do about a number with a comma where commas are no decimal marks, or with both marks."""

DECIMAL_COMMA_HINT = (
    "if commas are decimal marks, export it with points, or with semicolons or tabs between the columns"
)
"""What to do about a line with more fields than the table has columns."""

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(nan|inf(inity)?)", re.IGNORECASE)


def read_lines(path: Path) -> Iterator[str]:
    """Lines of a text file, without line ends.

    Raises:
        BadInput: no such file, a line longer than ``MAX_LINE_CHARACTERS``, or a zero byte.
    """
    try:
        with path.open("rb") as beginning:
            encoding = _encoding(beginning.read(BEGINNING_BYTES))
        file = path.open(encoding=encoding, errors="replace")
    except OSError as error:
        raise BadInput(f"cannot be read: {error.strerror}", file=path, hint="name the instrument's file") from None
    with file:
        for number, line in enumerate(iter(lambda: file.readline(MAX_LINE_CHARACTERS), ""), 1):
            if len(line) == MAX_LINE_CHARACTERS or "\0" in line:
                raise BadInput(f"line {number} is no line of a table", file=path, hint="check the file's format")
            yield line.rstrip("\r\n")


def _encoding(beginning: bytes) -> str:
    """Encoding of a text by its first bytes: that of Windows where they are neither UTF-16 nor UTF-8."""
    if beginning[:2] in UTF_16_MARKS:
        return "utf-16"
    try:
        getincrementaldecoder("utf-8")().decode(beginning)  # may end within a character
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8-sig"


def split_fields(line: str, separator: str) -> list[str]:
    """Fields of a line, without surrounding blanks and quotes. A separator within quotes is part of its field."""
    quoted = '"' in line
    parts = next(csv.reader([line], delimiter=separator, skipinitialspace=True)) if quoted else line.split(separator)
    return [part.strip() for part in parts]


def count_filled(fields: Sequence[str]) -> int:
    """Number of fields up to the last one that is not empty."""
    return max((at for at, text in enumerate(fields, 1) if text), default=0)


def parse_number(text: str, decimal: str = ".") -> float | None:
    """The number in ``text``; NaN if it is empty, None if it is not a number with that decimal mark."""
    text = text.strip().strip('"').strip()
    if not text:
        return float("nan")
    if decimal != ".":
        text = text.replace(".", "_").replace(decimal, ".")  # a point beside decimal commas makes it no number
    return float(text) if _NUMBER.fullmatch(text) else None


def is_numeric(line: str, separator: str, decimal: str = ".") -> bool:
    """Whether all fields of a line are numbers or empty, and at least one is a number."""
    fields = split_fields(line, separator)
    return any(fields) and all(parse_number(field, decimal) is not None for field in fields)


def parse_number_blocks(
    lines: Iterable[str],
    path: Path,
    separator: str,
    columns: Sequence[int],
    line: int,
    decimal: str = ".",
    width: int | None = None,
) -> Iterator[Array]:
    """Numbers of selected columns, in blocks of shape (n, columns). An empty field is NaN; empty lines are skipped.

    Args:
        lines: of the table.
        path: of the file, for messages.
        separator: between fields.
        columns: positions of the columns, from 0.
        line: number of the first line in the file, for messages.
        decimal: decimal mark.
        width: number of columns of the table, behind which a line may have empty fields only; None for any fields.

    Raises:
        BadInput: a field that is not a number, a line that ends before the last column, or one with a field behind it.
    """
    lines, last = iter(lines), np.inf if width is None else width - 1
    while block := list(islice(lines, LINES_PER_BLOCK)):
        try:
            longer = (text.rstrip(separator).count(separator) > last for text in block)
            if decimal != "." or not all(block) or any(longer):
                raise ValueError
            yield np.loadtxt(block, delimiter=separator, usecols=columns, ndmin=2, comments=None)
        except (ValueError, IndexError):  # empty or further fields, quotes or an error: line by line, slowly
            rows = ((line + at, text) for at, text in enumerate(block) if text.strip())
            numbers = [_row(text, at, path, separator, columns, decimal, width) for at, text in rows]
            if numbers:
                yield np.array(numbers)
        line += len(block)


def _row(
    text: str, line: int, path: Path, separator: str, columns: Sequence[int], decimal: str, width: int | None
) -> list[float]:
    parts = split_fields(text, separator)
    if len(parts) <= max(columns):
        what = f"line {line} ends after {len(parts)} of {max(columns) + 1} columns"
        raise BadInput(what, file=path, hint="the file may be cut; export it again")
    if width is not None and count_filled(parts) > width:
        what = f"line {line} has {counted(count_filled(parts), 'field')}, and the table {counted(width, 'column')}"
        raise BadInput(what, file=path, hint=DECIMAL_COMMA_HINT if separator == "," else "repair or remove the line")
    numbers = [parse_number(parts[column], decimal) for column in columns]
    if None in numbers:
        wrong = parts[columns[numbers.index(None)]][:40]
        hint = ONE_MARK_HINT if "," in wrong or decimal == "," else "repair or remove the line"
        raise BadInput(f"line {line}: {wrong!r} is no number", file=path, hint=hint)
    return numbers  # type: ignore[return-value]
