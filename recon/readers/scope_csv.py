"""CSV as oscilloscopes write it: Rigol, Tektronix (two ways), Keysight/Agilent InfiniiVision, Rohde & Schwarz.

Each puts names, units and clock into other places of the lines above the numbers; see the functions below.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import numpy as np

from recon.readers.contents import Contents, Variable, clock_of, rate_of, spelled, spooled, unique
from recon.readers.table import Array, fields_of, is_numeric, lines_of, number_blocks, number_of
from scanner.errors import BadInput

MOST_HEADER_LINES = 200
HEADER_BYTES = 1 << 16
LEVELS = {"eRS_UNIT_LEVEL_V": "V", "eRS_UNIT_LEVEL_A": "A"}
_PROPERTY = re.compile(r'<Prop [^>]*?\bName="(\w+)"[^>]*? Value="([^"]*)"')
SECONDS = ("s", "sec", "second", "seconds")


@dataclass(frozen=True)
class Layout:
    """Where a table's columns and its clock are.

    Attributes:
        kind: who writes it so.
        names, units: of the columns. columns: their places in a line. first: lines before the table.
        times: which column holds times [s]. index: which counts samples.
        rate, start: as the header states them [Hz], [s].
        starts: the start [s] of a table of so many rows, where the header says it so.
        about: what else the header states.
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


def read_csv(path: Path) -> Contents:
    """Columns of an oscilloscope's CSV, or of another table with at most one line of names.

    A column that holds the file's times or counts its samples becomes the clock; in a table of unknown origin
    none does.

    Raises:
        BadInput: no such file, or a line that is no row of the table.
    """
    head = list(islice(lines_of(path), MOST_HEADER_LINES + 1))
    if not head:
        raise BadInput("the file is empty", file=path, hint="copy it again")
    if _fields(head[0])[0].lower() == "record length":
        layout, separator, decimal = _tektronix_beside(head), ",", "."
    else:
        first = next((at for at, line in enumerate(head) if is_numeric(line, *_marks(line))), None)
        if first is None:
            raise BadInput("holds no table of numbers", file=path, hint="name its format in the mapping")
        separator, decimal = _marks(head[first])
        above = [fields_of(line.lstrip("#"), separator) for line in head[:first]]
        layout = _layout(path, above, head[first], separator)
    rows = islice(lines_of(path), layout.first, None)
    table = spooled(number_blocks(rows, path, separator, layout.columns, layout.first + 1, decimal), path)
    return Contents(layout.kind, _variables(layout, table), layout.about)


def _variables(layout: Layout, table: Array) -> dict[str, Variable]:
    rate, start, note = layout.rate, layout.starts.get(len(table), layout.start), ""
    if layout.times is not None:
        told, start, note = clock_of(table[:, layout.times])
        rate = None if told is None else rate or told
    elif layout.index is not None:
        told, _, note = clock_of(table[:, layout.index])
        rate = None if told is None else rate
    signals = [at for at in range(len(layout.names)) if at not in (layout.times, layout.index)]
    return {
        name: Variable(table[:, at], spelled(layout.units[at]), rate, start if rate is not None else None, note)
        for at, name in zip(signals, unique(layout.names[at] for at in signals), strict=True)
    }


def _marks(line: str) -> tuple[str, str]:
    """Separator and decimal mark of a line of numbers."""
    for separator in ("\t", ";"):
        if separator in line:
            return separator, "," if "," in line else "."
    return ",", "."


def _fields(line: str) -> list[str]:
    return fields_of(line, ",")


def _layout(path: Path, head: list[list[str]], row: str, separator: str) -> Layout:
    """What the lines above the numbers say, by who writes such lines."""
    width = len(row.rstrip().rstrip(separator).split(separator))
    keys = {line[0].lower(): line[1:] for line in head if line}
    if not head:
        return _rohde_schwarz(path, width)
    if head[0][0] == "X" and {"Start", "Increment"} <= set(head[0]) and len(head) > 1:
        return _rigol(head)
    if head[0][0].lower() == "x-axis" and len(head) > 1:
        units = _padded(head[1], width)
        times = 0 if units[0].lower() in SECONDS else None
        return Layout("Keysight InfiniiVision CSV", _padded(head[0], width), units, range(width), len(head), times)
    if "sample interval" in keys and "horizontal units" in keys:
        return _tektronix_above(head, keys, width)
    return Layout("CSV", _padded(head[-1], width), [""] * width, range(width), len(head))


def _padded(fields: Sequence[str], width: int) -> list[str]:
    return [*fields, *[""] * width][:width]


def _rigol(head: list[list[str]]) -> Layout:
    """``X,CH1,CH2,Start,Increment`` over ``Sequence,Volt,Volt,-3e-07,5e-10``; the rows count samples."""
    said = dict(zip(head[0], head[1], strict=False))
    width = head[0].index("Start")
    rate, start = rate_of(number_of(said.get("Increment", ""))), _finite(number_of(said.get("Start", "")))
    units = ["", *_padded(head[1][1:], width - 1)]
    return Layout("Rigol CSV", head[0][:width], units, range(width), len(head), index=0, rate=rate, start=start)


def _tektronix_above(head: list[list[str]], keys: dict[str, list[str]], width: int) -> Layout:
    """MSO, DPO, MDO, TBS: lines of ``key,value``, the last one ``TIME,CH1``."""
    seconds = "".join(keys["horizontal units"][:1]).lower() in SECONDS
    units = ["", *_padded(keys.get("vertical units", []), width - 1)]
    rate = rate_of(number_of("".join(keys["sample interval"][:1]))) if seconds else None
    device = " ".join(keys.get("model", [])[:1])
    times = 0 if seconds and head[-1][0].lower() == "time" else None
    names = _padded(head[-1], width)
    about = {"device": device}
    return Layout("Tektronix CSV", names, units, range(width), len(head), times, None, rate, None, about)


def _tektronix_beside(head: list[str]) -> Layout:
    """TDS: 18 lines of ``key,value,,time,volts``, then ``,,,time,volts``."""
    said = {fields[0].lower(): "".join(fields[1:2]) for fields in map(_fields, head[:18])}
    seconds = said.get("horizontal units", "").lower() in SECONDS
    return Layout(
        "Tektronix TDS CSV", ["TIME", said.get("source") or "CH1"], ["", said.get("vertical units", "")], (3, 4), 0,
        0 if seconds else None, None, rate_of(number_of(said.get("sample interval", ""))) if seconds else None, None,
        {"device": said.get("model number", "")},
    )  # fmt: skip


def _rohde_schwarz(path: Path, width: int) -> Layout:
    """``NAME.Wfm.csv`` holds values only; unit and clock stand in ``NAME.csv`` beside it, or in ``NAME.bin``.

    The values are either those on the screen or all that were recorded, which their number tells.
    """
    said = _beside(path)
    rate = rate_of(number_of(said.get("SignalResolution", "")))
    screen, all_of_it = (_finite(number_of(said.get(key, ""))) for key in ("XStart", "HardwareXStart"))
    starts = {
        int(rows): start
        for rows, start in ((said.get("RecordLength"), screen), (said.get("SignalHardwareRecordLength"), all_of_it))
        if rows and rows.isdecimal() and len(rows) < 20 and start is not None
    }
    unit = LEVELS.get(said.get("BaseUnit", ""), "")
    kind = "Rohde & Schwarz CSV" if said else "CSV without a header"
    return Layout(
        kind, [""] * width, [unit] * width, range(width), 0, rate=rate, start=None if starts else all_of_it,
        starts=starts,
    )  # fmt: skip


def _beside(path: Path) -> dict[str, str]:
    """What the header beside ``NAME.Wfm.csv`` states: ``key:value:`` in NAME.csv, else XML in NAME.bin."""
    if not path.name.lower().endswith(".wfm.csv"):
        return {}
    name = path.name[: -len(".Wfm.csv")]
    text, xml = path.with_name(f"{name}.csv"), path.with_name(f"{name}.bin")
    if text.is_file():
        pairs = (line.split(":", 2) for line in islice(lines_of(text), MOST_HEADER_LINES))
        return {pair[0]: pair[1] for pair in pairs if len(pair) > 1}
    if xml.is_file():
        with xml.open("rb") as file:
            return dict(_PROPERTY.findall(file.read(HEADER_BYTES).decode(errors="replace")))
    return {}


def _finite(number: float | None) -> float | None:
    return number if number is not None and np.isfinite(number) else None
