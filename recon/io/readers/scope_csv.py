"""CSV as oscilloscopes write it: Rigol, Tektronix (two ways), Keysight/Agilent InfiniiVision, Rohde & Schwarz.

Each manufacturer writes names, units and clock to different places above the numbers; see the functions below.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path

import numpy as np

from recon.io.readers.column_names import TIME_NAMES, TIME_UNITS, find_time_column, name_columns
from recon.io.readers.contents import (
    Contents,
    Variable,
    agree_on_clock,
    infer_clock,
    map_blocks,
    normalise_unit,
    rate_from_step,
    unique_names,
)
from recon.io.readers.reader import Reader
from recon.io.readers.table_start import find_table, separator_and_mark, split_settings
from recon.io.readers.text_table import (
    DECIMAL_COMMA_HINT,
    ONE_MARK_HINT,
    count_filled,
    parse_number,
    parse_number_blocks,
    read_lines,
    split_fields,
)
from scanner.arrays import Array
from scanner.errors import BadInput
from scanner.wording import counted

MAX_HEADER_LINES = 200
"""Lines in which the table has to begin; headers of oscilloscopes have tens of lines."""
MAX_XML_HEADER_BYTES = 1 << 16
"""Bytes of a Rohde & Schwarz .bin file that are searched for properties, so that a large file costs no memory."""
ROHDE_SCHWARZ_UNITS = {"eRS_UNIT_LEVEL_V": "V", "eRS_UNIT_LEVEL_A": "A"}
"""Units as Rohde & Schwarz names them."""
_PROPERTY = re.compile(r'<Prop [^>]*?\bName="(\w+)"[^>]*? Value="([^"]*)"')
NO_TABLE_HINT = "name its format in the mapping, or make every column numbers, without marks between thousands"
"""What to do about a text without a row of numbers."""
_NUMBER_LIKE = re.compile(r"[+-]?\d[\d.,]*([eE][+-]?\d+)?")
"""Digits with marks anywhere, as ``1,234.5``."""
BESIDE_COLUMNS = (3, 4)
"""Columns of time and signal in a Tektronix table that stands beside its settings, which others write above theirs."""
NAMES_OF_SECONDS = ("s", "sec", "second", "seconds")
"""Spellings of the unit of a column of times."""


@dataclass(frozen=True)
class Layout:
    """Where the columns and the clock of a table are stated.

    Attributes:
        kind: name of the format.
        names, units: of the columns.
        columns: their positions in a line.
        first: number of lines before the table.
        times: index of the column that holds times [s].
        index: index of the column that counts samples.
        rate: stated sample rate [Hz].
        start: stated time of the first sample [s].
        starts: start [s] by number of rows, if the header states it that way.
        clock: index of the column of times of a table of no known format; it stays a variable.
        clock_scale: seconds of its unit.
        about: other statements of the header.
    """

    kind: str
    names: Sequence[str]
    units: Sequence[str]
    columns: Sequence[int]
    first: int
    times: int | None = None
    index: int | None = None
    rate: float | None = None
    start: float | None = None
    about: dict[str, str] = field(default_factory=dict)
    starts: Mapping[int, float] = field(default_factory=dict)
    clock: int | None = None
    clock_scale: float = 1.0


def read_csv(path: Path) -> Contents:
    """Columns of an oscilloscope's CSV file, or of another table with names and perhaps units above its columns.

    In a known format the column of times or sample numbers becomes the clock. In another table a column does that is
    named as a time and states a unit of time; it remains a variable.

    Raises:
        BadInput: no such file, or a line that is no row of the table.
    """
    head = list(islice(read_lines(path), MAX_HEADER_LINES + 1))
    if not head:
        raise BadInput("the file is empty", file=path, hint="copy it again")
    first_line = _fields(head[0])
    if first_line[0].lower() == "record length" and len(first_line) > max(BESIDE_COLUMNS):
        layout, separator, decimal = _tektronix_beside(head), ",", "."
    else:
        first = find_table(head)
        if first is None:
            what = f"holds no table of numbers{_describe_other_field(head)}"
            raise BadInput(what, file=path, hint=NO_TABLE_HINT)
        separator = separator_and_mark(head[first])[0]
        decimal = "," if separator in "\t;" and any("," in line for line in head[first:]) else "."
        head = [_single_blanks(line, separator) for line in head]
        settings, above = split_settings(head[:first])
        layout = _layout(path, [split_fields(line.lstrip("#"), separator) for line in above], head[first], separator)
        layout = replace(layout, first=first, about={**layout.about, **({"notes": settings} if settings else {})})
    rows = (_single_blanks(line, separator) for line in islice(read_lines(path), layout.first, None))
    width = max(layout.columns) + 1
    blocks = parse_number_blocks(rows, path, separator, layout.columns, layout.first + 1, decimal, width)
    table = map_blocks(blocks, path)
    return Contents(layout.kind, _variables(layout, table), layout.about)


def _variables(layout: Layout, table: Array) -> dict[str, Variable]:
    rate, start, note = layout.rate, layout.starts.get(len(table), layout.start), ""
    if layout.times is not None:
        rate, start, note = agree_on_clock(table[:, layout.times], rate)
    elif layout.index is not None:
        samples_per_row, _, note = infer_clock(table[:, layout.index])
        rate = None if samples_per_row is None else rate
    elif layout.clock is not None:
        rate, start, note = infer_clock(table[:, layout.clock])
        rate = None if rate is None else float(f"{rate / layout.clock_scale:.12g}")
        start = None if start is None else start * layout.clock_scale
    signals = [at for at in range(len(layout.names)) if at not in (layout.times, layout.index)]
    variables, names = {}, unique_names(layout.names[at] for at in signals)
    times = [name for at, name in zip(signals, names, strict=True) if layout.names[at].lower() in TIME_NAMES]
    if rate is None and not note and len(times) > 1:
        note = f"{' and '.join(times)} are times: choose those of the channel by --time"
    for at, name in zip(signals, names, strict=True):
        unit = normalise_unit(layout.units[at])
        if at == layout.clock:
            variables[name] = Variable(table[:, at], unit, note=note or "the clock of the other columns")
        elif layout.clock is None and layout.times is None and name.lower() in TIME_NAMES:
            variables[name] = Variable(table[:, at], unit, note=f"if these are seconds, state it: --time {name}")
        else:
            variables[name] = Variable(table[:, at], unit, rate, start if rate is not None else None, note)
    return variables


def _describe_other_field(lines: Sequence[str]) -> str:
    """Words on the first line that holds a number: its field that is none, as a time of day; empty without one."""
    for number, line in enumerate(lines, 1):
        separator, decimal = separator_and_mark(line)
        parts = split_fields(line, separator)
        known = [parse_number(part, decimal) is not None for part in parts]
        if any(part and good for part, good in zip(parts, known, strict=True)) and not all(known):
            return f": in line {number} {parts[known.index(False)][:40]!r} is no number"
    return ""


def _single_blanks(line: str, separator: str) -> str:
    """The line without repeated blanks where blanks separate its fields."""
    return " ".join(line.split()) if separator == " " else line


def _fields(line: str) -> list[str]:
    return split_fields(line, ",")


def _layout(path: Path, head: list[list[str]], row: str, separator: str) -> Layout:
    """The layout that the lines above the numbers state; the manufacturer is recognised by its keys."""
    cells = split_fields(row, separator)
    width = max(count_filled(cells), min(len(cells), count_filled(head[-1]) if head else 0))
    keys = {line[0].lower(): line[1:] for line in head if line}
    if not head:
        return _rohde_schwarz(path, width)
    if head[0][0] == "X" and {"Start", "Increment"} <= set(head[0]) and len(head) > 1:
        return _rigol(head)
    if head[0][0].lower() == "x-axis" and len(head) > 1:
        units = _padded(head[1], width)
        times = 0 if units[0].lower() in NAMES_OF_SECONDS else None
        return Layout("Keysight InfiniiVision CSV", _padded(head[0], width), units, range(width), len(head), times)
    if "sample interval" in keys and "horizontal units" in keys:
        return _tektronix_above(head, keys, width)
    _check_marks(path, head, row, separator, width)
    names, units = name_columns(head, width)
    clock = find_time_column(names, units)
    scale = 1.0 if clock is None else TIME_UNITS[units[clock].lower()]
    return Layout("CSV", names, units, range(width), len(head), clock=clock, clock_scale=scale)


def _check_marks(path: Path, head: list[list[str]], row: str, separator: str, width: int) -> None:
    """Raise BadInput if the line above the first row is a row too, or commas are decimal marks and separators."""
    names = head[-1]
    odd = [field for field in names if "," in field or field.count(".") > 1]
    if odd and all(_NUMBER_LIKE.fullmatch(field) for field in names if field):
        raise BadInput(f"line {len(head)}: {odd[0][:40]!r} is no number", file=path, hint=ONE_MARK_HINT)
    if separator == "," and "." not in row and len(names) < width <= 2 * len(names):
        what = f"its lines have {width} numbers without a point, and its heading {counted(len(names), 'name')}"
        raise BadInput(what, file=path, hint=DECIMAL_COMMA_HINT)


def _padded(fields: Sequence[str], width: int) -> list[str]:
    return [*fields, *[""] * width][:width]


def _rigol(head: list[list[str]]) -> Layout:
    """``X,CH1,CH2,Start,Increment`` over ``Sequence,Volt,Volt,-3e-07,5e-10``; the rows count samples."""
    fields = dict(zip(head[0], head[1], strict=False))
    width = head[0].index("Start")
    rate, start = (
        rate_from_step(parse_number(fields.get("Increment", ""))),
        _finite(parse_number(fields.get("Start", ""))),
    )
    units = ["", *_padded(head[1][1:], width - 1)]
    return Layout("Rigol CSV", head[0][:width], units, range(width), len(head), index=0, rate=rate, start=start)


def _tektronix_above(head: list[list[str]], keys: dict[str, list[str]], width: int) -> Layout:
    """MSO, DPO, MDO, TBS, and Siglent: lines of ``key,value``, the last one ``TIME,CH1``, or ``Second,Volt`` below
    ``Source,CH1``."""
    seconds = "".join(keys["horizontal units"][:1]).lower() in NAMES_OF_SECONDS
    stated = [unit.rpartition(":")[2] for unit in keys.get("vertical units", [])]  # Siglent writes CH1:V
    units = ["", *_padded(stated, width - 1)]
    rate = rate_from_step(parse_number("".join(keys["sample interval"][:1]))) if seconds else None
    device = " ".join((keys.get("model") or keys.get("model number") or [])[:1])
    times = 0 if seconds and head[-1][0].lower() in TIME_NAMES else None
    sources = [name for name in keys.get("source", []) if name]
    names = [head[-1][0], *sources] if len(sources) == width - 1 else _padded(head[-1], width)
    about = {"device": device}
    return Layout("Tektronix CSV", names, units, range(width), len(head), times, None, rate, None, about)


def _tektronix_beside(head: list[str]) -> Layout:
    """TDS: 18 lines of ``key,value,,time,volts``, then ``,,,time,volts``."""
    header = {fields[0].lower(): "".join(fields[1:2]) for fields in map(_fields, head[:18])}
    seconds = header.get("horizontal units", "").lower() in NAMES_OF_SECONDS
    return Layout(
        "Tektronix TDS CSV",
        ["TIME", header.get("source") or "CH1"],
        ["", header.get("vertical units", "")],
        columns=BESIDE_COLUMNS,
        first=0,
        times=0 if seconds else None,
        rate=rate_from_step(parse_number(header.get("sample interval", ""))) if seconds else None,
        about={"device": header.get("model number", "")},
    )


def _rohde_schwarz(path: Path, width: int) -> Layout:
    """``NAME.Wfm.csv`` holds values only; unit and clock are in ``NAME.csv`` or ``NAME.bin`` in the same folder.

    The values are those on the screen or all that were recorded; the number of rows decides which.
    """
    header = _read_header_beside(path)
    rate = rate_from_step(parse_number(header.get("SignalResolution", "")))
    screen_start, full_start = (_finite(parse_number(header.get(key, ""))) for key in ("XStart", "HardwareXStart"))
    starts = {
        int(rows): start
        for rows, start in (
            (header.get("RecordLength"), screen_start),
            (header.get("SignalHardwareRecordLength"), full_start),
        )
        if rows and rows.isdecimal() and len(rows) < 20 and start is not None
    }
    unit = ROHDE_SCHWARZ_UNITS.get(header.get("BaseUnit", ""), "")
    kind = "Rohde & Schwarz CSV" if header else "CSV without a header"
    return Layout(
        kind, [""] * width, [unit] * width, range(width), 0, rate=rate, start=None if starts else full_start,
        starts=starts,
    )  # fmt: skip


def _read_header_beside(path: Path) -> dict[str, str]:
    """Header of ``NAME.Wfm.csv`` in a separate file: lines ``key:value:`` in NAME.csv, else XML in NAME.bin."""
    if not path.name.lower().endswith(".wfm.csv"):
        return {}
    name = path.name[: -len(".Wfm.csv")]
    text, xml = path.with_name(f"{name}.csv"), path.with_name(f"{name}.bin")
    if text.is_file():
        pairs = (line.split(":", 2) for line in islice(read_lines(text), MAX_HEADER_LINES))
        return {pair[0]: pair[1] for pair in pairs if len(pair) > 1}
    if xml.is_file():
        with xml.open("rb") as file:
            return dict(_PROPERTY.findall(file.read(MAX_XML_HEADER_BYTES).decode(errors="replace")))
    return {}


def _finite(number: float | None) -> float | None:
    return number if number is not None and np.isfinite(number) else None


READER = Reader("csv", read_csv, suffixes=(".csv", ".tsv", ".txt"))
