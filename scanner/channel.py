"""One recorded signal: samples that are read when asked for, with a unit and a clock."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from math import ceil, isfinite, pi
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from scanner.arrays import Array
from scanner.errors import BadInput, UnitUnknown
from scanner.hdf5 import DAMAGE

READ_CHUNK_SAMPLES = 1 << 17
"""Samples read at a time where a whole channel is processed: 1 MB of doubles, which fits the second-level cache."""

MIN_SAMPLE_RATE_HZ, MAX_SAMPLE_RATE_HZ = 1e-6, 1e15
"""Accepted sample rates: from one sample in twelve days to one in a femtosecond. Others are errors of unit."""

MAX_TIME_ROUNDING_SAMPLES = 1e-3
"""Largest accepted rounding of the time of a sample [samples]. At ten samples in a period of the motion it is a phase
error of 0.02 degrees. Times since 1970 at 1 MS/s are rounded to a quarter of a sample."""

CUT_ROUNDING_SAMPLES = 1e-6
"""A sample that lies less than this before a cut belongs to the part after it [samples]: rounding of times moved it."""

MAX_MAGNITUDE = 1e100
"""Largest accepted magnitude of a sample: no measurement reaches it, and sums of its square do not overflow."""

MIN_CLIPPED_RUN_SAMPLES = 8
"""Length of a run of equal samples at an extreme value from which they count as clipped [samples].

Noise makes so many equal samples in a row improbable as long as its standard deviation is about a converter's step.
"""

CHANNEL_UNITS = {
    "drive_x": "V", "drive_y": "V", "bias_x": "V", "bias_y": "V",
    "sense_x": "V", "sense_y": "V", "sense": "V",
    "angle_x": "rad", "angle_y": "rad",
    "velocity_x": "rad/s", "velocity_y": "rad/s",
    "acceleration_x": "rad/s2", "acceleration_y": "rad/s2",
    "phase_x": "rad", "phase_y": "rad",
    "range": "m", "position_z": "m",
}  # fmt: skip
"""Unit of the samples that a channel returns, by its name. Other channels keep the unit that they were recorded in."""

CONVERSIONS = {
    "V": {"V": 1.0, "mV": 1e-3, "uV": 1e-6},
    "rad": {"rad": 1.0, "mrad": 1e-3, "urad": 1e-6, "deg": pi / 180},
    "rad/s": {"rad/s": 1.0, "mrad/s": 1e-3, "deg/s": pi / 180},
    "m": {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "km": 1e3, "um": 1e-6, "µm": 1e-6, "nm": 1e-9},
    "rad/s2": {"rad/s2": 1.0, "rad/s²": 1.0, "rad/s^2": 1.0, "mrad/s2": 1e-3, "deg/s2": pi / 180},
}
"""Accepted units for each unit of ``CHANNEL_UNITS``, with the factor that converts to it."""


AMPLITUDE_CHANNELS = ("amplitude_x", "amplitude_y")
"""Amplitudes of a lock-in amplifier or an envelope detector: an angle, or a voltage behind the device's readout."""

USED_CHANNELS = (*CHANNEL_UNITS, *AMPLITUDE_CHANNELS, "intensity")
"""Names of the channels that have a meaning. Others are kept and not used."""

PHASE_CHANNELS = ("phase_x", "phase_y")
"""Phases of a lock-in amplifier, which belong to the amplitudes."""

DBM_LEVEL_V = float(np.sqrt(2.0 * 50.0 * 1e-3))
"""Amplitude of a sine of 1 mW in 50 ohm [V]: 0 dBm as spectrum analysers and lock-in amplifiers state it."""


class SampleSource(Protocol):
    """Storage of samples: a numpy array, an HDF5 dataset, or another object that reads when it is sliced."""

    @property
    def dtype(self) -> np.dtype[Any]: ...
    @property
    def shape(self) -> tuple[int, ...]: ...
    @property
    def ndim(self) -> int: ...
    def __getitem__(self, rows: slice, /) -> NDArray[Any]: ...


@dataclass(frozen=True)
class LazySamples:
    """Samples that are read by a function when they are sliced along the first axis.

    Attributes:
        shape, dtype: of all samples.
        fetch: (first, stop) -> samples ``first`` up to ``stop``.
    """

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
        raw: storage of the samples.
        first, stop: range of ``raw`` that belongs to this channel.
        gain, offset: conversion of raw samples to the unit.
        file: where the channel came from, for messages.
        detectors: names of the columns, where they are stated.
        reference: of a lock-in amplifier's output, its frequency [Hz] or the name of the channel that holds it.
    """

    name: str
    unit: str
    sample_rate: float
    start: float
    raw: SampleSource
    first: int
    stop: int
    gain: float = 1.0
    offset: float = 0.0
    file: str | None = None
    detectors: tuple[str, ...] = ()
    reference: float | str | None = None

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
        """Time one sample after the last one [s]."""
        return self.start + self.size / self.sample_rate

    def sample_from(self, time: float) -> int:
        """Return the number of the first sample at or after a time [s], from 0 to ``size``.

        Parts of a recording begin and end there, so that parts that adjoin share no sample.
        """
        samples = (time - self.start) * self.sample_rate - CUT_ROUNDING_SAMPLES
        if not isfinite(samples):
            return 0 if samples < 0 else self.size
        return min(max(ceil(samples), 0), self.size)

    def read(self, first: int = 0, stop: int | None = None) -> Array:
        """Return samples ``first`` up to ``stop`` (as in a Python slice), shape (n,) or (n, detectors), in ``unit``.

        Only these samples are read from the file.

        Raises:
            BadInput: the samples cannot be read (truncated or damaged file, HDF5 filter that is not installed).
        """
        return self.scaled(self.stored(first, stop))

    def scaled(self, stored: NDArray[Any]) -> Array:
        """Return stored samples converted to ``unit``: gain * stored + offset, of the same shape."""
        values = stored.astype(np.float64)
        if self.gain != 1.0:
            values *= self.gain
        if self.offset != 0.0:
            values += self.offset
        return values

    def stored(self, first: int = 0, stop: int | None = None) -> NDArray[Any]:
        """Return the samples that :meth:`read` converts, as stored. The caller must not change them. Raises as that."""
        low, high, _ = slice(first, stop).indices(self.size)
        try:
            return self.raw[self.first + low : self.first + max(low, high)]
        except BadInput:
            raise
        except DAMAGE as error:
            hint = "the file is damaged or truncated; copy it again"
            raise BadInput(f"samples cannot be read: {error}", file=self.file, channel=self.name, hint=hint) from None

    def time(self, first: int = 0, stop: int | None = None) -> Array:
        """Return the times of the samples that :meth:`read` returns, shape (n,) [s]."""
        return self.start + np.arange(*slice(first, stop).indices(self.size)) / self.sample_rate


def make_channel(
    name: str,
    raw: SampleSource,
    *,
    unit: object,
    sample_rate: object,
    start: object = 0.0,
    gain: object = 1.0,
    offset: object = 0.0,
    file: str | None = None,
    detectors: object = (),
    reference: object = None,
    level: object = None,
) -> Channel:
    """Return a channel after checking everything stated about it, in the unit that belongs to its name.

    Args:
        name: of the channel.
        raw: real samples, shape (n,). For names outside ``CHANNEL_UNITS``, as the intensity, (n, detectors) is accepted
            too, and so are Boolean samples, as 0 and 1.
        unit: of ``gain * raw + offset``.
        sample_rate: [Hz].
        start: time of the first sample [s].
        gain, offset: conversion of raw samples to ``unit``.
        file: for messages.
        detectors: names of the columns: a sequence of texts, or one text with commas; none if empty.
        reference: of ``amplitude_x`` and ``phase_x``: frequency [Hz] or the name of the channel that holds it.
        level: amplitude at 0 dB, of ``amplitude_x`` in dB or dBm [V]; ``DBM_LEVEL_V`` by default for dBm.

    Raises:
        UnitUnknown: the unit is missing or cannot be converted to that of the channel.
        BadInput: no samples, samples that are not real numbers, a wrong shape, an impossible rate, start or gain,
            or names that are not one for each detector.
    """

    def bad(what: str, hint: str) -> BadInput:
        return BadInput(what, file=file, channel=name, hint=hint)

    if raw.dtype.kind == "b" and name not in CHANNEL_UNITS:  # a photon or none
        raw = _zeros_and_ones(raw)
    if raw.dtype.kind not in "iuf":
        raise bad(f"holds {raw.dtype}, not real numbers", "store integers or floats")
    max_dimensions = 1 if name in CHANNEL_UNITS else 2
    if not 1 <= raw.ndim <= max_dimensions:
        expected = "(n,)" if max_dimensions == 1 else "(n,) or (n, detectors)"
        raise bad(f"has shape {raw.shape}", f"store it as {expected}")
    if 0 in raw.shape:
        raise bad("holds no samples", "record it again or leave the channel out")
    numbers = {"sample_rate": sample_rate, "start": start, "gain": gain, "offset": offset}
    for key, value in numbers.items():
        if not _is_number(value):
            state = "is missing" if value is None else f"is {value!r}, not a finite number"
            raise bad(f"{key} {state}", f"state {key} as a number")
    rate, first_time, slope, zero = (float(value) for value in numbers.values())  # type: ignore[arg-type]
    if not MIN_SAMPLE_RATE_HZ <= rate <= MAX_SAMPLE_RATE_HZ:
        raise bad(
            f"sample_rate is {rate:g} Hz", f"state a rate from {MIN_SAMPLE_RATE_HZ:g} to {MAX_SAMPLE_RATE_HZ:g} Hz"
        )
    rounding = float(np.spacing(abs(first_time) + raw.shape[0] / rate))
    if rounding * rate > MAX_TIME_ROUNDING_SAMPLES:
        raise bad(
            f"starts at {first_time:g} s, where times have steps of {rounding:.2g} s ({rounding * rate:.2g} samples)",
            "state start from the beginning of the measurement, and its date in notes",
        )
    if slope == 0:
        raise bad("gain is 0, which leaves nothing of the samples", "state value = gain * raw + offset")
    if reference is not None and not isinstance(reference, str) and not (_is_number(reference) and reference > 0.0):  # type: ignore[operator]
        raise bad(f"reference is {reference!r}", "state a frequency in Hz, or the name of the channel that holds it")
    if name in AMPLITUDE_CHANNELS and unit in ("dB", "dBm"):
        level = DBM_LEVEL_V if level is None and unit == "dBm" else level
        if not _is_number(level) or not level > 0.0:  # type: ignore[operator]
            raise bad("level is missing for an amplitude in dB", "state level, the amplitude in V at 0 dB")
        raw, unit, slope, zero = _linear_samples(raw, slope, zero, float(level)), "V", 1.0, 0.0  # type: ignore[arg-type]
    channel_unit, factor = _channel_unit(name, unit, file)
    names = _detector_names(detectors)
    columns = raw.shape[1] if raw.ndim == 2 else 1
    if names and (len(names) != columns or len(set(names)) != len(names) or not all(names)):
        raise bad(f"names the detectors {', '.join(names)}", f"give {columns} different names, one for each detector")
    gain, offset = slope * factor, zero * factor
    return Channel(name, channel_unit, rate, first_time, raw, 0, raw.shape[0], gain, offset, file, names, reference)  # type: ignore[arg-type]


def _zeros_and_ones(raw: SampleSource) -> LazySamples:
    """Boolean samples as integers, converted when they are read."""

    def fetch(first: int, stop: int) -> NDArray[Any]:
        return raw[first:stop].astype(np.uint8)

    return LazySamples(raw.shape, np.dtype(np.uint8), fetch)


def _linear_samples(raw: SampleSource, gain: float, offset: float, level: float) -> LazySamples:
    """Samples ``level * 10^((gain raw + offset) / 20)`` of an amplitude in dB, computed when they are read."""

    def fetch(first: int, stop: int) -> NDArray[Any]:
        return level * 10.0 ** ((gain * np.asarray(raw[first:stop], np.float64) + offset) / 20.0)

    return LazySamples(raw.shape, np.dtype(np.float64), fetch)


def _detector_names(stated: object) -> tuple[str, ...]:
    """Names from a text with commas, or from a sequence of texts or bytes."""
    if isinstance(stated, str):
        stated = stated.split(",")
    names = np.asarray(stated).ravel().tolist()
    return tuple((n.decode("utf-8", "replace") if isinstance(n, bytes) else str(n)).strip() for n in names)


def _is_number(value: object) -> bool:
    if not isinstance(value, (int, float, np.integer, np.floating)) or isinstance(value, bool):
        return False
    with suppress(OverflowError):  # an integer of TOML may be too large for a float
        return isfinite(value)
    return False


def _channel_unit(name: str, unit: object, file: str | None) -> tuple[str, float]:
    """The unit of the samples that the channel returns, and the factor that converts to it."""
    if name in AMPLITUDE_CHANNELS:
        for channel_unit in ("rad", "V"):
            if unit in CONVERSIONS[channel_unit]:
                return channel_unit, CONVERSIONS[channel_unit][str(unit)]
        what = "unit is missing" if unit is None else f"unit {unit!r} is unknown"
        hint = f"accepted units: {', '.join((*CONVERSIONS['rad'], *CONVERSIONS['V'], 'dB', 'dBm'))}"
        raise UnitUnknown(what, file=file, channel=name, hint=hint)
    if name not in CHANNEL_UNITS:
        return (unit if isinstance(unit, str) else ""), 1.0
    channel_unit = CHANNEL_UNITS[name]
    if unit not in CONVERSIONS[channel_unit]:
        what = "unit is missing" if unit is None else f"unit {unit!r} is unknown"
        hint = f"accepted units: {', '.join(CONVERSIONS[channel_unit])}"
        if channel_unit != "m" and str(unit).startswith(("m/s", "mm/s", "um/s")):
            hint += "; divide a motion in metres by the distance of the spot from the axis"
        raise UnitUnknown(what, file=file, channel=name, hint=hint)
    return channel_unit, CONVERSIONS[channel_unit][str(unit)]
