"""Contents of an instrument's file, in one form for all formats: variables whose samples are read when sliced.

A unit or a sample rate that the file does not state is None.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.channel import READ_CHUNK_SAMPLES, LazySamples, SampleSource
from scanner.errors import BadInput

UNIT_SPELLINGS = {
    "volt": "V", "volts": "V", "v": "V", "millivolt": "mV", "millivolts": "mV", "mv": "mV",
    "radian": "rad", "radians": "rad", "rad": "rad", "degree": "deg", "degrees": "deg", "deg": "deg",
    "ampere": "A", "amperes": "A", "amp": "A", "amps": "A", "a": "A",
}  # fmt: skip
"""Spelling of a unit in a recording, by the spelling in instruments' files in lower case."""

MAX_CLOCK_DEVIATION_SAMPLES = 0.4
"""Deviation of a time from the line through the first and the last time, above which the times are not uniform.

One dropped or doubled sample moves at least one time by half a sample; the rounding of printed times moves them less.
"""


def _close_nothing() -> None:
    """For contents without an open file."""


@dataclass(frozen=True)
class Variable:
    """One variable of an instrument's file.

    Attributes:
        raw: samples, of any type and shape.
        unit: of the samples, as a recording spells it; None if the file states none.
        sample_rate: [Hz]; None if the file states none.
        start: time of the first sample [s]; None if the file states none.
        note: remark for the user, for example why there is no sample rate.
    """

    raw: SampleSource
    unit: str | None = None
    sample_rate: float | None = None
    start: float | None = None
    note: str = ""

    @property
    def is_signal(self) -> bool:
        """Whether it can become a channel: real numbers, one or two dimensions, not empty."""
        return self.raw.dtype.kind in "iuf" and self.raw.ndim in (1, 2) and 0 not in self.raw.shape


@dataclass(frozen=True)
class Contents:
    """Contents of a file.

    Attributes:
        kind: format in words, for example "Rigol CSV".
        variables: by name, in the file's order.
        about: other statements of the file: ``device``, ``acquired``, ``notes``.
        close: closes the file; call it after the last read.
    """

    kind: str
    variables: Mapping[str, Variable]
    about: Mapping[str, str] = field(default_factory=dict)
    close: Callable[[], None] = _close_nothing


def flatten_vector(raw: SampleSource) -> SampleSource:
    """Samples of shape (1, n) or (n, 1) as (n,); other shapes unchanged."""
    if raw.ndim != 2 or 1 not in raw.shape:
        return raw
    if raw.shape[0] != 1:
        return LazySamples(raw.shape[:1], raw.dtype, lambda first, stop: raw[first:stop][:, 0])
    return LazySamples(raw.shape[1:], raw.dtype, lambda first, stop: raw[0:1][0, first:stop])


def matrix_row(raw: SampleSource, row: int) -> SampleSource:
    """Row of a matrix of shape (signals, n), as samples of shape (n,) that are read when they are sliced."""
    return LazySamples(raw.shape[1:], raw.dtype, lambda first, stop: raw[row : row + 1][0, first:stop])


def normalise_unit(unit: str) -> str | None:
    """A unit as a recording spells it; an unknown unit unchanged; None for an empty text."""
    return UNIT_SPELLINGS.get(unit.strip().lower(), unit.strip()) or None


def map_blocks(blocks: Iterable[NDArray[Any]], file: Path) -> NDArray[Any]:
    """Stack blocks of shape (n, columns) in a memory-mapped temporary file, so that memory holds one block at a time.

    Raises:
        BadInput: there are no rows.
    """
    # The memory map has its own handle of the unnamed file; the system deletes the file with the map or the process.
    with tempfile.TemporaryFile() as store:
        rows, shape, dtype = 0, (0,), np.dtype(np.float64)
        for block in blocks:
            store.write(np.ascontiguousarray(block).data)
            rows, shape, dtype = rows + len(block), block.shape[1:], block.dtype
        if not rows:
            raise BadInput("holds no samples", file=file, hint="record or export it again")
        store.flush()
        return np.memmap(store, dtype, mode="r", shape=(rows, *shape))


MIN_JUMP_STEPS = 1.5
"""Step of time in usual steps from which it is a jump. Rounding of printed times is looked for by the straight line."""


def rate_from_step(step: object) -> float | None:
    """Sample rate [Hz] from a sample interval [s], rounded to 15 digits as 1/5e-10 is not 2e9; None if not positive."""
    if not isinstance(step, (int, float)) or not 0 < step < np.inf or not np.isfinite(1 / np.float64(step)):
        return None
    return float(f"{1 / step:.15g}")


def infer_clock(times: SampleSource) -> tuple[float | None, float | None, str]:
    """Sample rate [Hz] and start [s] of a column of times [s].

    Returns:
        Rate (None if the times are not uniform), start, and a note that says where they are not uniform, else empty.
    """
    size = times.shape[0]
    missing = _first_missing(times)
    if missing is not None:
        return None, None, f"the time of sample {missing} is missing"
    first, last = (float(times[at : at + 1][0]) for at in (0, size - 1))
    with np.errstate(all="ignore"):
        step = (np.float64(last) - first) / max(size - 1, 1)
        if size < 2 or not 0 < step < np.inf or not 0 < 1 / step < np.inf:
            return None, None, "its times do not rise"
        for low in range(0, size, READ_CHUNK_SAMPLES):
            block = np.asarray(times[low : low + READ_CHUNK_SAMPLES], np.float64)
            off = np.abs((block - first) / step - np.arange(low, low + len(block)))
            if not (off < MAX_CLOCK_DEVIATION_SAMPLES).all():
                row = int(np.argmin(off < MAX_CLOCK_DEVIATION_SAMPLES))
                what = _find_jump(times, size) or f"sample {low + row} lies {off[row]:.3g} samples off"
                return None, first, f"its times are not uniform: {what}"
    return float(1 / step), first, ""


def agree_on_clock(times: SampleSource, stated: float | None) -> tuple[float | None, float | None, str]:
    """Sample rate [Hz] and start [s] of a column of times [s] beside a stated rate [Hz], and a note, else empty.

    The stated rate has more digits than printed times, and is used where both agree within a sample over the column.
    Elsewhere that of the times is, as in a table of which every tenth row was kept.
    """
    measured, start, note = infer_clock(times)
    if measured is None or not stated:
        return measured, start, note
    if abs(stated / measured - 1.0) * times.shape[0] <= 1.0:
        return stated, start, note
    return float(f"{measured:.12g}"), start, f"its times give {measured:.6g} Hz, and the header states {stated:.6g} Hz"


def _first_missing(times: SampleSource) -> int | None:
    """Index of the first time that is not finite; None if all are."""
    for low in range(0, times.shape[0], READ_CHUNK_SAMPLES):
        finite = np.isfinite(np.asarray(times[low : low + READ_CHUNK_SAMPLES], np.float64))
        if not finite.all():
            return low + int(np.argmin(finite))
    return None


def _find_jump(times: SampleSource, size: int) -> str:
    """Where times first fall, or else jump, for good, in words; empty where single times are off or none is."""
    usual = float(np.median(np.diff(np.asarray(times[: min(size, READ_CHUNK_SAMPLES)], np.float64))))
    if not usual > 0.0:
        return "most of them are equal to the one before, because they are stated with too few digits"
    jump = ""
    for low in range(0, size - 1, READ_CHUNK_SAMPLES):
        begin = max(low - 1, 0)
        block = np.asarray(times[begin : low + READ_CHUNK_SAMPLES + 2], np.float64)
        steps, pairs = np.diff(block), np.full(block.size + 1, np.inf)
        pairs[1:-2] = block[2:] - block[:-2]  # over a time that alone is off, two steps together are as usual
        lasting = (np.abs(pairs[:-2] - 2.0 * usual) > usual / 2) & (np.abs(pairs[1:-1] - 2.0 * usual) > usual / 2)
        falls = np.flatnonzero(lasting & (steps < 0.0))
        if falls.size:
            at = int(falls[0])
            return f"sample {begin + at + 1} is {-steps[at]:.4g} s earlier than the one before; remove what is repeated"
        rises = np.flatnonzero(lasting & (steps > MIN_JUMP_STEPS * usual))
        if rises.size and not jump:
            at = int(rises[0])
            jump = f"sample {begin + at + 1} is {steps[at]:.4g} s later than the one before, not {usual:.4g} s"
    return jump


def unique_names(names: Iterable[str]) -> list[str]:
    """Make names unique: repeated names are all numbered, so that none of them stands for the first one; an empty name
    becomes ``column N``."""
    filled = [name.strip() or f"column {index}" for index, name in enumerate(names, 1)]
    out: list[str] = []
    for name in filled:
        number = 1
        candidate = f"{name} (1)" if filled.count(name) > 1 else name
        while candidate in out:
            number += 1
            candidate = f"{name} ({number})"
        out.append(candidate)
    return out
