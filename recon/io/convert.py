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

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from recon.io.mapped_channel import (
    Request,
    describe_counts,
    describe_times,
    find_variable,
    is_scaled,
    map_channel,
    map_edges,
)
from recon.io.readers import read
from recon.io.readers.contents import Contents
from scanner.device import Device
from scanner.edges import EDGE_CHANNELS
from scanner.errors import BadInput
from scanner.files import check_no_input, read_toml
from scanner.hdf5 import check_ends
from scanner.recording import Recording

TEXT_KEYS = ("format", "name", "notes", "acquired")
MAPPING_KEYS = (*TEXT_KEYS, "channels", "device")

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


def convert_file(source: Path, mapping: Path | Plan, output: Path, by_options: bool = False) -> dict[str, Any]:
    """Write the recording that ``mapping`` makes of ``source``, chunk by chunk.

    Args:
        source: the instrument's file.
        mapping: TOML file or its content.
        output: recording to write.
        by_options: the mapping was made of the command's options, which messages name in its place.

    Returns:
        Summary: ``recording``, ``source``, ``format``, ``duration`` [s], ``device`` (its name or None) and, for each of
        ``channels``, ``variable``, ``unit``, ``stated_unit`` (from which the samples were converted to ``unit``),
        ``sample_rate`` [Hz], ``start`` [s], ``shape``, ``stated_by`` (the source of unit, rate and start) and
        ``overruled`` (statements of the file that the mapping contradicts); for each of ``edges``, ``number`` and
        ``event``; ``notes`` on what may be misunderstood.

    Raises:
        BadInput: as :func:`convert`.
    """
    check_no_input(output, source, *([] if isinstance(mapping, Mapping) else [mapping]))
    check_ends(source)
    plan, plan_source = _plan(mapping)
    plan_source = None if by_options else plan_source
    contents = _contents(source, plan, plan_source)
    with _recording(contents, source, plan, plan_source) as recording:
        requests = [Request(name, plan["channels"][name], contents, source, plan_source) for name in recording.channels]
        found = [describe(request) for describe in (describe_counts, describe_times) for request in requests]
        notes = list(dict.fromkeys(note for note in found if note))
        recording.write(output)
        return {
            "recording": str(output),
            "source": str(source),
            "format": contents.kind,
            "duration": recording.duration,
            "device": None if recording.device is None else recording.device.name,
            "channels": {
                name: {key: getattr(channel, key) for key in ("unit", "sample_rate", "start", "shape")}
                | _origin(plan["channels"][name], contents, "option" if by_options else "mapping")
                for name, channel in recording.channels.items()
            },
            "edges": {name: {"number": each.times.size, "event": each.event} for name, each in recording.edges.items()},
            "notes": notes,
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
    return (mapping, "mapping") if isinstance(mapping, Mapping) else (read_toml(mapping), mapping)


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
        asked = {name: Request(name, spec, contents, source, plan_source) for name, spec in plan["channels"].items()}
        channels = {name: map_channel(request) for name, request in asked.items() if name not in EDGE_CHANNELS}
        edges = {name: map_edges(request) for name, request in asked.items() if name in EDGE_CHANNELS}
    except BaseException:
        contents.close()
        raise
    attrs = {"name": source.stem, "source": source.name, "source_format": contents.kind} | dict(contents.about)
    attrs |= {key: plan[key] for key in TEXT_KEYS if key in plan and key != "format"}
    text = None if device is None else device.to_toml()
    return Recording(MappingProxyType(channels), MappingProxyType(attrs), None, text, contents, MappingProxyType(edges))


def _origin(spec: Mapping[str, Any], contents: Contents, mapping: str) -> dict[str, Any]:
    """Which variable a channel comes from, and which source states its unit and clock; ``mapping``: the word for it."""
    names = spec["variable"] if isinstance(spec["variable"], list) else [spec["variable"]]
    variable = contents.variables[str(find_variable(names[0], contents.variables))]
    stated = {key: getattr(variable, key) for key in ("unit", "sample_rate", "start")}
    by = {key: "file" if value is not None else "default: 0" for key, value in stated.items()}
    by |= dict.fromkeys((key for key in stated if key in spec), mapping)
    by |= {key: f"variable {spec['time']}" for key in ("sample_rate", "start") if "time" in spec and key not in spec}
    overruled = {
        key: value
        for key, value in stated.items()
        if key in spec and value not in (None, spec[key]) and not (is_scaled(spec) and key == "unit")
    }
    unit = spec.get("unit", variable.unit)
    return {"variable": ", ".join(names), "stated_unit": unit, "stated_by": by, "overruled": overruled}
