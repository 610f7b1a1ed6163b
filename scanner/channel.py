"""One recorded signal: samples that are read when asked for, with a unit and a clock."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from math import isfinite, pi
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from scanner.errors import BadInput, UnitUnknown
from scanner.hdf5 import DAMAGE

Array = NDArray[np.float64]

CHUNK = 1 << 17
"""Samples that are looked at in one go where a whole channel has to pass by: they stay in the cache."""

SLOWEST, FASTEST = 1e-6, 1e15
"""Sample rates that a clock can have [Hz]."""

LARGEST = 1e100
"""Values beyond are no measurement, and their squares no numbers."""

CHANNEL_UNITS = {
    "drive_x": "V", "drive_y": "V", "bias_x": "V", "bias_y": "V",
    "sense_x": "V", "sense_y": "V", "sense": "V",
    "angle_x": "rad", "angle_y": "rad",
}  # fmt: skip
"""Unit in which a channel is handed out; channels that do not stand here keep the unit they were recorded in."""

CONVERSIONS = {
    "V": {"V": 1.0, "mV": 1e-3, "uV": 1e-6},
    "rad": {"rad": 1.0, "mrad": 1e-3, "urad": 1e-6, "deg": pi / 180},
}
"""Units accepted for each unit handed out, and what to multiply by."""


class Samples(Protocol):
    """Where a channel's samples are: numpy's array, HDF5's dataset, or another that reads when it is sliced."""

    @property
    def dtype(self) -> np.dtype[Any]: ...
    @property
    def shape(self) -> tuple[int, ...]: ...
    @property
    def ndim(self) -> int: ...
    def __getitem__(self, rows: slice, /) -> NDArray[Any]: ...


@dataclass(frozen=True)
class Lazy:
    """Samples that ``fetch(first, stop)`` reads, along the first axis."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    fetch: Callable[[int, int], NDArray[Any]]

    @property
    def ndim(self) -> int:
        return len(self.shape)

    def __getitem__(self, rows: slice) -> NDArray[Any]:
        first, stop, _ = rows.indices(self.shape[0])
        return self.fetch(first, max(first, stop))


@dataclass(frozen=True, eq=False)
class Channel:
    """Samples ``gain * raw + offset`` on a uniform clock.

    Attributes:
        name: of the channel.
        unit: of what :meth:`read` returns.
        sample_rate: [Hz].
        start: time of the first sample on the recording's clock [s].
        raw: where the samples are; ``first`` and ``stop`` bound this channel's part of them.
        gain, offset: what turns raw samples into the unit.
        file: where the channel came from, for messages.
    """

    name: str
    unit: str
    sample_rate: float
    start: float
    raw: Samples
    first: int
    stop: int
    gain: float = 1.0
    offset: float = 0.0
    file: str | None = None

    @property
    def size(self) -> int:
        """Number of samples."""
        return self.stop - self.first

    @property
    def shape(self) -> tuple[int, ...]:
        """``(size,)``, or ``(size, detectors)``."""
        return (self.size, *self.raw.shape[1:])

    @property
    def end(self) -> float:
        """One sample after the last one [s]."""
        return self.start + self.size / self.sample_rate

    def read(self, first: int = 0, stop: int | None = None) -> Array:
        """Samples ``first`` up to ``stop`` (as in a Python slice), shape (n,) or (n, detectors), in ``unit``.

        Reads no more of the file than that.

        Raises:
            BadInput: the file does not give the samples back (truncated, damaged, a filter that is not installed).
        """
        return self.scaled(self.stored(first, stop))

    def scaled(self, stored: NDArray[Any]) -> Array:
        """Samples as they are stored, in ``unit``: gain * stored + offset, of the same shape."""
        values = stored.astype(np.float64)
        if self.gain != 1.0:
            values *= self.gain
        if self.offset != 0.0:
            values += self.offset
        return values

    def stored(self, first: int = 0, stop: int | None = None) -> NDArray[Any]:
        """The same samples in the type and scale they are stored in; not to be written to. Raises as :meth:`read`."""
        low, high, _ = slice(first, stop).indices(self.size)
        try:
            return self.raw[self.first + low : self.first + max(low, high)]
        except BadInput:
            raise
        except DAMAGE as error:
            hint = "the file is damaged or truncated; copy it again"
            raise BadInput(f"samples cannot be read: {error}", file=self.file, channel=self.name, hint=hint) from None

    def time(self, first: int = 0, stop: int | None = None) -> Array:
        """Times of the samples that :meth:`read` gives, shape (n,) [s]."""
        return self.start + np.arange(*slice(first, stop).indices(self.size)) / self.sample_rate


def checked_channel(
    name: str,
    raw: Samples,
    *,
    unit: object,
    sample_rate: object,
    start: object = 0.0,
    gain: object = 1.0,
    offset: object = 0.0,
    file: str | None = None,
) -> Channel:
    """A channel, once everything said about it has been checked, in the unit that its name stands for.

    Raises:
        UnitUnknown: a unit that the channel's name does not go with.
        BadInput: no samples, not numbers, wrong shape, or a clock that is not one.
    """

    def bad(what: str, hint: str) -> BadInput:
        return BadInput(what, file=file, channel=name, hint=hint)

    if raw.dtype.kind not in "iuf":
        raise bad(f"holds {raw.dtype}, not real numbers", "store integers or floats")
    most = 1 if name in CHANNEL_UNITS else 2
    if not 1 <= raw.ndim <= most:
        wanted = "(n,)" if most == 1 else "(n,) or (n, detectors)"
        raise bad(f"has shape {raw.shape}", f"store it as {wanted}")
    if 0 in raw.shape:
        raise bad("holds no samples", "record it again or leave the channel out")
    numbers = {"sample_rate": sample_rate, "start": start, "gain": gain, "offset": offset}
    for key, value in numbers.items():
        if not _is_number(value):
            state = "is missing" if value is None else f"is {value!r}, not a finite number"
            raise bad(f"{key} {state}", f"state {key} as a number")
    rate, first_time, slope, zero = (float(value) for value in numbers.values())  # type: ignore[arg-type]
    if not SLOWEST <= rate <= FASTEST:
        raise bad(f"sample_rate is {rate:g} Hz", f"state a rate from {SLOWEST:g} to {FASTEST:g} Hz")
    if (abs(first_time) + raw.shape[0] / rate) * rate > 2**52:
        raise bad(f"starts at {first_time:g} s, where its samples have one and the same time", "state start near 0")
    if slope == 0:
        raise bad("gain is 0, which leaves nothing of the samples", "state value = gain * raw + offset")
    own, factor = _own_unit(name, unit, file)
    return Channel(name, own, rate, first_time, raw, 0, raw.shape[0], slope * factor, zero * factor, file)


def check_signal(signal: Channel, *, constant_ok: bool = False, gaps_ok: bool = False) -> None:
    """Look through a whole channel, chunk by chunk, for what no estimator can work with.

    Args:
        signal: a channel of one or more columns.
        constant_ok: a channel that never changes is fine (a bias).
        gaps_ok: samples that are not finite are missing, and that is fine.

    Raises:
        BadInput: a sample that is not finite (with the time of the first one) or no measurement, no sample at all that
            is, or a signal that never changes.
    """
    low, high = np.inf, -np.inf
    for first in range(0, signal.size, CHUNK):
        values = signal.stored(first, first + CHUNK)
        least, most = float(values.min()), float(values.max())
        if not (isfinite(least) and isfinite(most)):  # the least of samples of which one is NaN is NaN
            finite = np.isfinite(values).reshape(len(values), -1).all(axis=1)
            if not gaps_ok:
                index = first + int(np.argmin(finite))
                what = f"sample {index} at {signal.start + index / signal.sample_rate:.9g} s is not finite"
                hint = "cut the recording there or repair the sample"
                raise BadInput(what, file=signal.file, channel=signal.name, hint=hint)
            if not finite.any():
                continue
            least, most = float(values[finite].min()), float(values[finite].max())
        low, high = min(low, least), max(high, most)
    if low > high:
        hint = "check that it was recorded"
        raise BadInput("holds no sample that can be used", file=signal.file, channel=signal.name, hint=hint)
    low, high = sorted((signal.gain * low + signal.offset, signal.gain * high + signal.offset))
    if max(-low, high) > LARGEST:
        what = f"reaches {max(-low, high):.3g} {signal.unit}"
        raise BadInput(what, file=signal.file, channel=signal.name, hint="check its type, gain and offset")
    if low == high and not constant_ok:
        what = f"stays at {low:.9g} {signal.unit} throughout"
        raise BadInput(what, file=signal.file, channel=signal.name, hint="check that it was connected")


def _is_number(value: object) -> bool:
    if not isinstance(value, (int, float, np.integer, np.floating)) or isinstance(value, bool):
        return False
    with suppress(OverflowError):  # TOML's integers have no limit, a float has one
        return isfinite(value)
    return False


def _own_unit(name: str, unit: object, file: str | None) -> tuple[str, float]:
    """The unit a channel is handed out in and the factor that gets it there."""
    if name not in CHANNEL_UNITS:
        return (unit if isinstance(unit, str) else ""), 1.0
    own = CHANNEL_UNITS[name]
    if unit not in CONVERSIONS[own]:
        what = "unit is missing" if unit is None else f"unit {unit!r} is unknown"
        hint = f"accepted units: {', '.join(CONVERSIONS[own])}"
        raise UnitUnknown(what, file=file, channel=name, hint=hint)
    return own, CONVERSIONS[own][str(unit)]
