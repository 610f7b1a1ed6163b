"""One channel of a recording from the variables of an instrument's file, as a mapping or options state it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from recon.io.readers.column_names import TIME_UNITS, split_label
from recon.io.readers.contents import Contents, Variable, flatten_vector, infer_clock, matrix_row
from recon.io.sampled_edges import find_edges
from scanner.arrays import Array
from scanner.channel import (
    AMPLITUDE_CHANNELS,
    CHANNEL_UNITS,
    CONVERSIONS,
    PHASE_CHANNELS,
    Channel,
    LazySamples,
    SampleSource,
    make_channel,
)
from scanner.edges import EDGE_UNITS, Edges, make_edges
from scanner.errors import BadInput, UnitUnknown

CHANNEL_KEYS = ("variable", "unit", "sample_rate", "start", "time", "scale", "offset", "row", "reference", "level")
CLOCK_KEYS = ("sample_rate", "start", "time")
EDGE_KEYS = ("variable", "unit", "event", "angle", "hysteresis", *CLOCK_KEYS)

OPTION_OF_KEY = {"unit": "--unit {name}=UNIT", "sample_rate": "--rate {name}=HZ or --time {name}=COLUMN"}
"""Option that states a key of a channel."""

COUNT_UNITS = ("count", "counts", "cts", "digit", "digits", "lsb", "adu")
"""Names of the unit of raw values of a converter, in lower case."""

MIN_DISTINCT_COUNTS = 17
"""Distinct integers from which floating-point values are classified as counts: more than those of a converter of four
bits. A square wave of whole volts has two."""

COUNT_SAMPLES = 1 << 16
"""Samples at the beginning that are tested for integer values."""


@dataclass(frozen=True)
class Request:
    """What is asked of one channel, and the words for messages about it.

    Attributes:
        name: of the channel.
        spec: content of ``[channels.<name>]``.
        contents: of the instrument's file.
        source: that file.
        stated_in: mapping file, or the word for a dictionary; None for options of the command.
    """

    name: str
    spec: Any
    contents: Contents
    source: Path
    stated_in: object

    def bad(self, what: str, hint: str) -> BadInput:
        """The exception for a statement that cannot be used."""
        if self.stated_in is None:
            return BadInput(what, file=self.source, channel=self.name, hint=hint)
        return BadInput(what, file=self.stated_in, channel=f"channels.{self.name}", hint=hint)

    def how_to_state(self, key: str) -> str:
        """How a missing key is stated: by a line of the mapping or by an option."""
        return f"add {OPTION_OF_KEY[key].format(name=self.name) if self.stated_in is None else f'{key} = ...'}"

    @property
    def place(self) -> str:
        """The file, and what assigns its variables."""
        return str(self.source) if self.stated_in is None else f"{self.source} by {self.stated_in}"

    @property
    def holds(self) -> str:
        """The variables of the file, as a hint."""
        return f"{self.source.name} holds {format_variables(self.contents.variables)}"


def map_channel(request: Request) -> Channel:
    """The channel that is asked for; its samples are read when they are used.

    Raises:
        BadInput: the statements are incomplete, name a variable that the file does not hold, or one that is no signal.
        UnitUnknown: the channel cannot have the stated unit.
    """
    spec, name = request.spec, request.name
    _check_spec(request)
    names = spec["variable"] if isinstance(spec["variable"], list) else [spec["variable"]]
    variables = [_find(request, each) for each in names]
    variable = variables[0] if len(variables) == 1 else join_columns(variables, names, request.bad)
    if len(variables) > 1 and name in (*AMPLITUDE_CHANNELS, *PHASE_CHANNELS):
        variable = _from_quadratures(variable, name in PHASE_CHANNELS, request.bad)
    scaled = is_scaled(spec)
    scale, offset = _number(spec.get("scale", 1.0)), _number(spec.get("offset", 0.0))
    if not scale or offset is None:
        raise request.bad("scale must be a number other than 0, offset a number", "channel = scale * variable + offset")
    rate, start = _stated_clock(request, variable)
    unit = spec.get("unit", None if scaled else variable.unit)  # the file states the unit before scaling
    for key, value in (("sample_rate", rate), ("unit", unit)):
        if value is None:
            raise _not_stated(request, key, variable)
    lock_in = {key: spec.get(key) for key in ("reference", "level")}
    try:
        return make_channel(
            name,
            _samples(request, variable),
            unit=unit,
            sample_rate=rate,
            start=start,
            gain=scale,
            offset=offset,
            detectors=names if name == "intensity" and len(names) > 1 else (),
            file=request.place,
            **lock_in,
        )
    except UnitUnknown as error:
        if str(unit).lower() not in COUNT_UNITS:
            raise
        example = (
            f"--scale {name}=0.0005 --unit {name}=V" if request.stated_in is None else 'scale = 0.0005, unit = "V"'
        )
        hint = f"{error.hint}; of counts of a converter, state the unit after scaling and its size per count: {example}"
        raise UnitUnknown(error.what, file=error.file, channel=error.channel, hint=hint) from None


def _stated_clock(request: Request, variable: Variable) -> tuple[Any, Any]:
    """Sample rate [Hz], None where nothing states it, and start [s] of a channel, by its statements, else by the file.

    Raises:
        BadInput: times and rate are both stated, or the times are no clock.
    """
    spec = request.spec
    if "time" not in spec:
        return spec.get("sample_rate", variable.sample_rate), spec.get("start", variable.start or 0.0)
    if "sample_rate" in spec:
        raise request.bad("says time and sample_rate", "the times state the rate")
    times = _find(request, spec["time"])
    rate, first_time = _clock(times, spec["time"], request.bad)
    number, size = flatten_vector(times.raw).shape[0], _samples(request, variable).shape[0]
    if number != size:
        what = f"time = {spec['time']!r} holds {number} times, and {spec['variable']!r} {size} samples"
        raise request.bad(what, "name the column of their times, or state the sample rate in their place")
    return rate, spec.get("start", first_time)


def _not_stated(request: Request, key: str, variable: Variable) -> BadInput:
    """The exception for a key that neither the statements nor the file contain."""
    because = f", and the file states none{f' ({variable.note})' if variable.note else ''}"
    what = f"no {key} is stated for variable {request.spec['variable']!r}{because}"
    return request.bad(what, f"{request.how_to_state(key)}; {request.holds}")


def is_scaled(spec: Mapping[str, Any]) -> bool:
    """Whether a mapping scales the values of the file."""
    return "scale" in spec or "offset" in spec


def describe_counts(request: Request) -> str | None:
    """Return a note if integer samples are interpreted in the channel's unit, for example as volts; None otherwise."""
    spec = request.spec
    unit = CHANNEL_UNITS.get(request.name)
    if unit is None or is_scaled(spec) or isinstance(spec["variable"], list):
        return None
    variable = _find(request, spec["variable"])
    if spec.get("unit", variable.unit) != unit:
        return None
    values = np.asarray(_samples(request, variable)[:COUNT_SAMPLES])
    if values.dtype.kind == "f":
        values = values[np.isfinite(values)]
        if (values != np.round(values)).any() or np.unique(values).size < MIN_DISTINCT_COUNTS:
            return None
    return (
        f"{request.name}: integer values from {values.min():.6g} to {values.max():.6g} are interpreted as {unit}; "
        f"if they have another unit, state it; if they are counts of a converter, state {unit} per count: "
        f"{f'--scale {request.name}=...' if request.stated_in is None else 'scale = ...'}"
    )


def describe_times(request: Request) -> str | None:
    """Return a note if times without a stated unit are interpreted as seconds; None otherwise."""
    name = request.spec.get("time")
    if name is None or _find(request, name).unit is not None:
        return None
    return (
        f"{name}: no unit is stated for these times, and they are interpreted as seconds; if they have another unit, "
        "state the sample rate in their place"
    )


def _check_spec(request: Request) -> None:
    """Check what is stated of a channel before the variables are looked for.

    Raises:
        BadInput: it is no table, has an unknown key or a value of a wrong type, or states no variable.
    """
    spec, name = request.spec, request.name
    if not isinstance(spec, dict):
        raise request.bad(f"is {spec!r} and must be a table", f"write [channels.{name}]")
    if "/" in name or not name.strip(".") or not name.isprintable():
        raise request.bad("is no name for a channel", "name it without / and control characters")
    if unknown := [key for key in spec if key not in CHANNEL_KEYS]:
        raise request.bad(f"{unknown[0]} is not a known key", f"known: {', '.join(CHANNEL_KEYS)}")
    for key in ("unit", "time"):
        if not isinstance(spec.get(key, ""), str):
            raise request.bad(f"{key} is {spec[key]!r} and must be text", "put it in quotes")
    if "variable" not in spec:
        raise request.bad("says no variable", f"add variable = ...; {request.holds}")
    names = spec["variable"] if isinstance(spec["variable"], list) else [spec["variable"]]
    if not names or not all(isinstance(each, str) for each in names):
        raise request.bad(f"variable is {spec['variable']!r} and must be text", "put it in quotes, or a list of names")


def _find(request: Request, name: str) -> Variable:
    """The variable of that name.

    Raises:
        BadInput: there is none, or there are several.
    """
    variables = request.contents.variables
    found = find_variable(name, variables)
    if found is None and find_variable(f"{split_label(name)[0]} (1)", variables):
        what = f"{request.source.name} names several variables {name!r}"
        raise request.bad(what, f"choose one by its number; {request.holds}")
    if found is None:
        raise request.bad(f"there is no variable {name!r}", request.holds)
    return variables[found]


def _samples(request: Request, variable: Variable) -> SampleSource:
    """Samples of the channel, shape (n,) or (n, detectors)."""
    spec, raw = request.spec, flatten_vector(variable.raw)
    if "row" in spec:
        if raw.ndim != 2 or spec["row"] not in range(raw.shape[0]):
            raise request.bad(
                f"there is no row {spec['row']!r} of {spec['variable']!r}", f"count from 0; {request.holds}"
            )
        raw = matrix_row(raw, spec["row"])
    if raw.ndim == 2 and raw.shape[0] < raw.shape[1]:
        hint = "choose a row of it by row = 0 in a mapping, or export it as (samples, detectors)"
        what = f"variable {spec['variable']!r} of shape {raw.shape} has fewer samples than detectors"
        raise request.bad(what, hint)
    return raw


def _from_quadratures(variable: Variable, wants_phase: bool, bad: Callable[[str, str], BadInput]) -> Variable:
    """Phase [rad] or amplitude from the in-phase and the quadrature part, the two columns of a variable."""
    if variable.raw.shape[-1] != 2:
        raise bad("variable lists other than two names", 'write variable = ["in-phase", "quadrature"]')

    def fetch(low: int, stop: int) -> Array:
        real, imaginary = np.asarray(variable.raw[low:stop], float).T
        return np.arctan2(imaginary, real) if wants_phase else np.hypot(real, imaginary)

    samples = LazySamples((variable.raw.shape[0],), np.dtype(float), fetch)
    unit = "rad" if wants_phase else variable.unit
    return Variable(samples, unit, variable.sample_rate, variable.start, variable.note)


def map_edges(request: Request) -> Edges:
    """The edge times that are asked for; the mapping states ``variable``, ``unit`` and ``event`` or ``angle``.

    A variable in volts is the sampled sync signal, whose clock is stated as that of every channel.

    Raises:
        BadInput: as ``map_channel``.
    """
    spec = request.spec
    if not isinstance(spec, dict) or not isinstance(spec.get("variable"), str):
        raise request.bad("says no variable", f"write [channels.{request.name}] with variable = ...")
    if unknown := [key for key in spec if key not in EDGE_KEYS]:
        raise request.bad(f"{unknown[0]} is not a known key of edges", f"known: {', '.join(EDGE_KEYS)}")
    variable = _find(request, spec["variable"])
    column = flatten_vector(variable.raw)
    if not variable.is_signal or column.ndim != 1:
        what = f"variable {spec['variable']!r} of shape {variable.raw.shape} is no list of numbers"
        raise request.bad(what, f"name the list of edge times, or the sync signal; {request.holds}")
    times = column[0 : column.shape[0]]
    clock = [key for key in CLOCK_KEYS if key in spec]
    stated = {"unit": variable.unit} | {key: spec[key] for key in spec if key not in ("variable", *clock)}
    if stated["unit"] in CONVERSIONS["V"]:  # the sync signal itself
        rate, start = (_number(value) for value in _stated_clock(request, variable))
        if rate is None and "sample_rate" not in spec:
            raise _not_stated(request, "sample_rate", variable)
        if rate is None or rate <= 0.0 or start is None:
            raise request.bad("sample_rate must be a number above 0, start a number", "state them in Hz and s")
        times = find_edges(np.asarray(times, np.float64), rate, start, str(stated.get("event", "both-edges")))
        if not times.size:
            raise request.bad(f"{spec['variable']!r} has no edge: it stays at one level", "name the sync signal")
        stated["unit"] = "s"
    elif clock and stated["unit"] in EDGE_UNITS:
        what = f"states {clock[0]}, but {spec['variable']!r} in {stated['unit']} is a list of edge times"
        hint = "state it of the other channels only; the unit of a sampled sync signal is V"
        raise request.bad(what, hint)
    return make_edges(request.name, times, stated, request.place)


def _clock(times: Variable, name: str, bad: Any) -> tuple[float, float]:
    column = flatten_vector(times.raw)
    if not times.is_signal or column.ndim != 1:
        raise bad(f"time = {name!r} is no column of numbers", "name the variable that holds the times [s]")
    rate, start, note = infer_clock(column)
    if rate is None or start is None:
        hint = "cut the file there, name the column of the times, or state the sample rate in their place"
        raise bad(f"time = {name!r} is no clock: {note}", hint)
    seconds = TIME_UNITS.get((times.unit or "s").lower())
    if seconds is None:
        raise bad(f"time = {name!r} has the unit {times.unit!r}", "name a column of times")
    return rate / seconds, start * seconds


def find_variable(name: str, variables: Mapping[str, Variable]) -> str | None:
    """The variable of that name, or of that heading with its unit, as ``CH1 (V)``; None if there is none."""
    bare = split_label(name)[0]
    return name if name in variables else bare if bare in variables else None


def join_columns(variables: Sequence[Variable], names: Sequence[str], bad: Callable[[str, str], BadInput]) -> Variable:
    """Several variables as the detectors of one, shape (n, detectors).

    Raises:
        BadInput: they differ in length, clock or unit.
    """
    first = variables[0]
    columns = [flatten_vector(each.raw) for each in variables]
    if any(each.ndim != 1 for each in columns):
        raise bad("variable lists a matrix", "list columns, or name the matrix alone")
    sizes = [each.shape[0] for each in columns]
    if len(set(sizes)) > 1:
        lengths = ", ".join(f"{name} {size}" for name, size in zip(names, sizes, strict=True))
        raise bad(f"its detectors differ in length: {lengths} samples", "cut them to one length")
    for key in ("unit", "sample_rate", "start"):
        if len({getattr(each, key) for each in variables}) > 1:
            raise bad(f"its detectors differ in {key}", "make a channel of each, or export them alike")
    dtype = np.result_type(*(each.dtype for each in columns))
    joined = LazySamples(
        (sizes[0], len(columns)), dtype, lambda low, stop: np.stack([each[low:stop] for each in columns], axis=-1)
    )
    return Variable(joined, first.unit, first.sample_rate, first.start, first.note)


def format_variables(variables: Mapping[str, Variable]) -> str:
    """Names and shapes of variables, of the first 20 if there are more."""
    texts = [f"{name} {variable.raw.shape}" for name, variable in variables.items()]
    return ", ".join(texts[:20]) + (f" and {len(texts) - 20} more" if len(texts) > 20 else "")


def _number(value: object) -> float | None:
    if not isinstance(value, (int, float)) or isinstance(value, bool):
        return None
    try:
        return float(value) if isfinite(value) else None
    except OverflowError:  # an integer in TOML may exceed the range of a float
        return None
