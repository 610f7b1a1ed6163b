"""What an instrument's file holds, in one form for all formats: variables that are read when they are sliced.

A reader says what the file states and nothing else: a unit or a rate that the file does not state is None.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.channel import CHUNK, Lazy, Samples
from scanner.errors import BadInput

UNITS = {
    "volt": "V", "volts": "V", "v": "V", "millivolt": "mV", "millivolts": "mV", "mv": "mV",
    "radian": "rad", "radians": "rad", "rad": "rad", "degree": "deg", "degrees": "deg", "deg": "deg",
    "ampere": "A", "amperes": "A", "amp": "A", "amps": "A", "a": "A",
}  # fmt: skip
"""How instruments spell units, in lower case, and what a recording calls them."""

# A dropped or doubled sample moves at least one time half a sample off the line through the first and the last one;
# the rounding of printed times moves them less.
_OFF_LINE = 0.4


def no_step() -> None:
    """Nothing to close."""


@dataclass(frozen=True)
class Variable:
    """One variable of an instrument's file.

    Attributes:
        raw: its samples, of any type and shape.
        unit: of the samples, as a recording spells it; None where the file states none.
        sample_rate: [Hz]; start: time of the first sample [s]; None where the file states none.
        note: what a reader of the file's list has to know, as why there is no rate.
    """

    raw: Samples
    unit: str | None = None
    sample_rate: float | None = None
    start: float | None = None
    note: str = ""

    @property
    def is_signal(self) -> bool:
        """Whether it can become a channel: real numbers, one or two dimensions, something in it."""
        return self.raw.dtype.kind in "iuf" and self.raw.ndim in (1, 2) and 0 not in self.raw.shape


@dataclass(frozen=True)
class Contents:
    """What a file holds.

    Attributes:
        kind: the format in words, as "Rigol CSV".
        variables: by name, in the file's order.
        about: what else it states: ``device``, ``acquired``, ``notes``.
        close: to be called when nothing is read any more.
    """

    kind: str
    variables: Mapping[str, Variable]
    about: Mapping[str, str] = field(default_factory=dict)
    close: Callable[[], None] = no_step


def line_up(raw: Samples) -> Samples:
    """Samples in one row, shape (1, n), one after the other, shape (n,); others as they are."""
    if raw.ndim != 2 or raw.shape[0] != 1:
        return raw
    return Lazy(raw.shape[1:], raw.dtype, lambda first, stop: raw[0:1][0, first:stop])


def spelled(unit: str) -> str | None:
    """A unit as a recording spells it, itself where it stands in no list; None for nothing."""
    return UNITS.get(unit.strip().lower(), unit.strip()) or None


def spooled(blocks: Iterable[NDArray[Any]], file: Path) -> NDArray[Any]:
    """Blocks (n, columns) one below the other, in a nameless temporary file, so that memory holds one block at a time.

    Raises:
        BadInput: there is not one row.
    """
    # The map below keeps the file, which goes when the map goes, or the process.
    store = tempfile.TemporaryFile()  # noqa: SIM115
    rows, shape, dtype = 0, (0,), np.dtype(np.float64)
    for block in blocks:
        store.write(np.ascontiguousarray(block).data)
        rows, shape, dtype = rows + len(block), block.shape[1:], block.dtype
    if not rows:
        raise BadInput("holds no samples", file=file, hint="record or export it again")
    store.flush()
    return np.memmap(store, dtype, mode="r", shape=(rows, *shape))


def rate_of(step: object) -> float | None:
    """Rate [Hz] of a step [s] printed in decimals, None where it is none; 15 digits, as 1/5e-10 is not quite 2e9."""
    if not isinstance(step, (int, float)) or not 0 < step < np.inf or not np.isfinite(1 / np.float64(step)):
        return None
    return float(f"{1 / step:.15g}")


def clock_of(times: Samples) -> tuple[float | None, float | None, str]:
    """Sample rate [Hz] and start [s] of a column of times [s]; without a rate where the times are not uniform.

    Returns:
        Rate, start, and a note that says where the times leave their line, empty where they do not.
    """
    size = times.shape[0]
    first, last = (float(times[at : at + 1][0]) for at in (0, size - 1))
    with np.errstate(all="ignore"):
        step = (np.float64(last) - first) / max(size - 1, 1)
        if size < 2 or not 0 < step < np.inf or not 0 < 1 / step < np.inf:
            return None, None, "its times do not rise"
        for low in range(0, size, CHUNK):
            block = np.asarray(times[low : low + CHUNK], np.float64)
            off = np.abs((block - first) / step - np.arange(low, low + len(block)))
            if not (off < _OFF_LINE).all():
                row = int(np.argmin(off < _OFF_LINE))
                what = f"its times are not uniform: sample {low + row} lies {off[row]:.3g} samples off"
                return None, first, what
    return float(1 / step), first, ""


def unique(names: Iterable[str]) -> list[str]:
    """The names, a number added where one comes again, and ``column N`` for an empty one."""
    out: list[str] = []
    for index, name in enumerate(names, 1):
        base = name.strip() or f"column {index}"
        tried, again = base, 1
        while tried in out:
            again += 1
            tried = f"{base} ({again})"
        out.append(tried)
    return out
