"""Recordings from instruments' files, by a mapping that states which variable is which channel.

A mapping (TOML) states for each channel the variable, its unit and its clock; it may contain the device::

    format = "matlab"               # only if neither the file's beginning nor its name shows it
    name = "afm-spiral"

    [channels.sense_x]
    variable = "x"                  # or a list: detectors of an intensity; in-phase and quadrature of a lock-in
    unit = "V"                      # after scaling
    sample_rate = 20000.0           # Hz; or time = "t", the variable that holds the times [s]
    start = 0.0                     # s
    scale = 1.0                     # channel = scale * variable + offset
    offset = 0.0
    row = 0                         # of a matrix whose rows are signals

    [device.x.readout]              # the device as in a device file, below [device]
    ...

Unit, rate and start may be omitted if the file states them. What neither states is not guessed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import isfinite
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from recon.io.readers import read
from recon.io.readers.column_names import TIME_UNITS, split_label
from recon.io.readers.contents import Contents, Variable, flatten_row, infer_clock, matrix_row
from recon.io.sampled_edges import find_edges
from scanner.arrays import Array
from scanner.channel import AMPLITUDE_CHANNELS, CONVERSIONS, PHASE_CHANNELS, Channel, LazySamples, make_channel
from scanner.device import Device
from scanner.edges import EDGE_CHANNELS, Edges, make_edges
from scanner.errors import BadInput
from scanner.files import check_no_input, read_toml
from scanner.hdf5 import check_ends
from scanner.recording import Recording

TEXT_KEYS = ("format", "name", "notes", "acquired")
MAPPING_KEYS = (*TEXT_KEYS, "channels", "device")
CHANNEL_KEYS = ("variable", "unit", "sample_rate", "start", "time", "scale", "offset", "row", "reference", "level")
EDGE_KEYS = ("variable", "unit", "event", "angle", "hysteresis")

Plan = Mapping[str, Any]
"""Content of a mapping file."""


def open_any(path: Path, mapping: Path | Plan | None = None, growing: bool = False) -> Recording:
    """Open a recording, or, with a mapping, an instrument's file as a recording.

    Samples are read when they are used. Close the recording, or use it in a ``with`` statement.

    Args:
        path: the file.
        mapping: TOML file or its content; None for a recording of this program.
        growing: the file is still being written, see :meth:`Recording.open`.

    Raises:
        BadInput: as :meth:`Recording.open` or :func:`convert`, or as :func:`scanner.hdf5.check_ends`.
    """
    check_ends(path)
    return Recording.open(path, growing) if mapping is None else convert(path, mapping)


def check_different(paths: Sequence[Path]) -> None:
    """Check that no recording is given twice: fitted together, it would count as two measurements.

    Raises:
        BadInput: one is.
    """
    files = [path.resolve() for path in paths]
    for at, file in enumerate(files):
        if file in files[:at]:
            raise BadInput("is given twice", file=paths[at], hint="name each recording once")


def convert_file(source: Path, mapping: Path | Plan, output: Path) -> dict[str, Any]:
    """Write the recording that ``mapping`` makes of ``source``, chunk by chunk.

    Returns:
        Summary: ``recording``, ``source``, ``format``, ``duration`` [s], ``device`` (its name or None) and, for each of
        ``channels``, ``variable``, ``unit``, ``sample_rate`` [Hz], ``start`` [s], ``shape``, ``stated_by`` (the source
        of unit, rate and start) and ``overruled`` (statements of the file that the mapping contradicts); for each of
        ``edges``, ``number`` and ``event``.

    Raises:
        BadInput: as :func:`convert`.
    """
    check_no_input(output, source, *([] if isinstance(mapping, Mapping) else [mapping]))
    check_ends(source)
    plan, plan_source = _plan(mapping)
    contents = _contents(source, plan, plan_source)
    with _recording(contents, source, plan, plan_source) as recording:
        recording.write(output)
        return {
            "recording": str(output),
            "source": str(source),
            "format": contents.kind,
            "duration": recording.duration,
            "device": None if recording.device is None else recording.device.name,
            "channels": {
                name: {key: getattr(channel, key) for key in ("unit", "sample_rate", "start", "shape")}
                | _origin(plan["channels"][name], contents)
                for name, channel in recording.channels.items()
            },
            "edges": {name: {"number": each.times.size, "event": each.event} for name, each in recording.edges.items()},
        }


def convert(source: Path, mapping: Path | Plan) -> Recording:
    """The recording that a mapping makes of an instrument's file; samples are read from that file when they are used.

    Args:
        source: the instrument's file.
        mapping: TOML file or its content.

    Raises:
        BadInput: the file cannot be read, the mapping is incomplete or names a variable that the file does not hold,
            or a variable is not a signal.
        DeviceInvalid: the mapping's device cannot be used.
        UnitUnknown: the mapping states a unit that the channel cannot have.
    """
    plan, plan_source = _plan(mapping)
    return _recording(_contents(source, plan, plan_source), source, plan, plan_source)


def _plan(mapping: Path | Plan) -> tuple[Plan, object]:
    """Content of the mapping and its source, for messages."""
    return (mapping, "arguments") if isinstance(mapping, Mapping) else (read_toml(mapping), mapping)


def _contents(source: Path, plan: Plan, plan_source: object) -> Contents:
    """Contents of ``source``, after the checks of the mapping that do not need them."""
    if unknown := [key for key in plan if key not in MAPPING_KEYS]:
        raise BadInput(
            "is not a known key", file=plan_source, channel=unknown[0], hint=f"known: {', '.join(MAPPING_KEYS)}"
        )
    for key in TEXT_KEYS:
        if not isinstance(plan.get(key, ""), str):
            raise BadInput(f"is {plan[key]!r} and must be text", file=plan_source, channel=key, hint="put it in quotes")
    if not isinstance(plan.get("channels"), dict) or not plan["channels"]:
        raise BadInput("names no channels", file=plan_source, hint="add a table [channels.<name>] for each")
    if not isinstance(plan.get("device", {}), dict):
        hint = "write [device.x.readout] and so on, or leave it out and give a device file with --device"
        raise BadInput("must be a table", file=plan_source, channel="device", hint=hint)
    return read(source, plan.get("format"))


def _recording(contents: Contents, source: Path, plan: Plan, plan_source: object) -> Recording:
    try:
        device = Device.from_table(plan["device"], source=str(plan_source)) if "device" in plan else None
        sampled = {name: spec for name, spec in plan["channels"].items() if name not in EDGE_CHANNELS}
        channels = {name: _channel(name, spec, contents, source, plan_source) for name, spec in sampled.items()}
        edges = {
            name: _edges(name, plan["channels"][name], contents, source, plan_source)
            for name in plan["channels"].keys() - sampled.keys()
        }
    except BaseException:
        contents.close()
        raise
    attrs = {"name": source.stem, "source": source.name, "source_format": contents.kind} | dict(contents.about)
    attrs |= {key: plan[key] for key in TEXT_KEYS if key in plan and key != "format"}
    text = None if device is None else device.to_toml()
    return Recording(MappingProxyType(channels), MappingProxyType(attrs), None, text, contents, MappingProxyType(edges))


def _origin(spec: Mapping[str, Any], contents: Contents) -> dict[str, Any]:
    """Which variable a channel comes from, and which source states its unit and clock."""
    names = spec["variable"] if isinstance(spec["variable"], list) else [spec["variable"]]
    variable = contents.variables[str(find_variable(names[0], contents.variables))]
    stated = {key: getattr(variable, key) for key in ("unit", "sample_rate", "start")}
    by = {key: "file" if value is not None else "default: 0" for key, value in stated.items()}
    by |= {key: "mapping" for key in stated if key in spec}
    by |= {key: f"variable {spec['time']}" for key in ("sample_rate", "start") if "time" in spec}
    scaled = "scale" in spec or "offset" in spec
    overruled = {
        key: value
        for key, value in stated.items()
        if key in spec and value not in (None, spec[key]) and not (scaled and key == "unit")
    }
    return {"variable": ", ".join(names), "stated_by": by, "overruled": overruled}


def _channel(name: str, spec: Mapping[str, Any], contents: Contents, source: Path, plan_source: object) -> Channel:
    def bad(what: str, hint: str) -> BadInput:
        return BadInput(what, file=plan_source, channel=f"channels.{name}", hint=hint)

    holds = f"{source.name} holds {format_variables(contents.variables)}"
    if not isinstance(spec, dict):
        raise bad(f"is {spec!r} and must be a table", f"write [channels.{name}]")
    if "/" in name or not name.strip(".") or not name.isprintable():
        raise bad("is no name for a channel", "name it without / and control characters")
    if unknown := [key for key in spec if key not in CHANNEL_KEYS]:
        raise bad(f"{unknown[0]} is not a known key", f"known: {', '.join(CHANNEL_KEYS)}")
    for key in ("unit", "time"):
        if not isinstance(spec.get(key, ""), str):
            raise bad(f"{key} is {spec[key]!r} and must be text", "put it in quotes")
    if "variable" not in spec:
        raise bad("says no variable", f"add variable = ...; {holds}")
    names = spec["variable"] if isinstance(spec["variable"], list) else [spec["variable"]]
    if not names or not all(isinstance(each, str) for each in names):
        raise bad(f"variable is {spec['variable']!r} and must be text", "put it in quotes, or a list of names")
    found: list[Variable] = []
    for name_in_file in (*names, *([spec["time"]] if "time" in spec else [])):
        variable_name = find_variable(name_in_file, contents.variables)
        if variable_name is None and find_variable(f"{split_label(name_in_file)[0]} (1)", contents.variables):
            what = f"{source.name} names several variables {name_in_file!r}"
            raise bad(what, f"choose one by its number; {holds}")
        if variable_name is None:
            raise bad(f"there is no variable {name_in_file!r}", holds)
        found.append(contents.variables[variable_name])
    variables, times = found[: len(names)], found[len(names) :]
    variable = variables[0] if len(variables) == 1 else join_columns(variables, names, bad)
    if len(variables) > 1 and name in (*AMPLITUDE_CHANNELS, *PHASE_CHANNELS):
        variable = _from_quadratures(variable, name in PHASE_CHANNELS, bad)
    scaled = "scale" in spec or "offset" in spec
    scale, offset = _number(spec.get("scale", 1.0)), _number(spec.get("offset", 0.0))
    if not scale or offset is None:
        raise bad("scale must be a number other than 0, offset a number", "channel = scale * variable + offset")
    rate: Any
    if "time" in spec:
        if "sample_rate" in spec or "start" in spec:
            raise bad("says time and sample_rate or start", "the times state both")
        rate, start = _clock(times[0], spec["time"], bad)
    else:
        rate, start = spec.get("sample_rate", variable.sample_rate), spec.get("start", variable.start or 0.0)
    unit = spec.get("unit", None if scaled else variable.unit)  # the file states the unit before scaling
    for key, value in (("sample_rate", rate), ("unit", unit)):
        if value is None:
            because = f", and the file states none{f' ({variable.note})' if variable.note else ''}"
            raise bad(f"says no {key} of variable {spec['variable']!r}{because}", f"add {key} = ...; {holds}")
    raw = flatten_row(variable.raw)
    if "row" in spec:
        if raw.ndim != 2 or spec["row"] not in range(raw.shape[0]):
            raise bad(f"there is no row {spec['row']!r} of {spec['variable']!r}", f"count from 0; {holds}")
        raw = matrix_row(raw, spec["row"])
    if raw.ndim == 2 and raw.shape[0] < raw.shape[1]:
        hint = "choose a row of it by row = 0 in a mapping, or export it as (samples, detectors)"
        raise bad(f"variable {spec['variable']!r} of shape {raw.shape} has fewer samples than detectors", hint)
    file = f"{source} by {plan_source}"
    lock_in = {key: spec.get(key) for key in ("reference", "level")}
    return make_channel(
        name,
        raw,
        unit=unit,
        sample_rate=rate,
        start=start,
        gain=scale,
        offset=offset,
        detectors=names if name == "intensity" and len(names) > 1 else (),
        file=file,
        **lock_in,
    )


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


def _edges(name: str, spec: Any, contents: Contents, source: Path, plan_source: object) -> Edges:
    """The edge times of one channel; their mapping states ``variable``, ``unit`` and ``event`` or ``angle``."""

    def bad(what: str, hint: str) -> BadInput:
        return BadInput(what, file=plan_source, channel=f"channels.{name}", hint=hint)

    if not isinstance(spec, dict) or not isinstance(spec.get("variable"), str):
        raise bad("says no variable", f"write [channels.{name}] with variable = ...")
    if unknown := [key for key in spec if key not in EDGE_KEYS]:
        raise bad(f"{unknown[0]} is not a known key of edges", f"known: {', '.join(EDGE_KEYS)}")
    if spec["variable"] not in contents.variables:
        what = f"there is no variable {spec['variable']!r}"
        raise bad(what, f"{source.name} holds {format_variables(contents.variables)}")
    variable = contents.variables[spec["variable"]]
    times = flatten_row(variable.raw)[0 : variable.raw.shape[-1]]
    stated = {"unit": variable.unit} | {key: value for key, value in spec.items() if key != "variable"}
    if stated["unit"] in CONVERSIONS["V"] and variable.sample_rate:  # the sync signal itself
        event = str(stated.get("event", "both-edges"))
        times = find_edges(np.asarray(times, np.float64), variable.sample_rate, variable.start or 0.0, event)
        stated["unit"] = "s"
    return make_edges(name, times, stated, f"{source} by {plan_source}")


def _clock(times: Variable, name: str, bad: Any) -> tuple[float, float]:
    column = flatten_row(times.raw)
    if not times.is_signal or column.ndim != 1:
        raise bad(f"time = {name!r} is no column of numbers", "name the variable that holds the times [s]")
    rate, start, note = infer_clock(column)
    if rate is None or start is None:
        raise bad(f"time = {name!r} is no clock: {note}", "cut the file there, or state sample_rate")
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
    columns = [flatten_row(each.raw) for each in variables]
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
