"""An instrument's file as a recording, by a mapping that says what each of its variables is.

A mapping (TOML) names for each channel the variable, its unit and its clock; it may carry the device::

    format = "matlab"               # where neither the file's beginning nor its name tells
    name = "afm-spiral"

    [channels.sense_x]
    variable = "x"
    unit = "V"                      # after scaling
    sample_rate = 20000.0           # Hz; or time = "t", the variable that holds the times [s]
    start = 0.0                     # s
    scale = 1.0                     # channel = scale * variable + offset
    offset = 0.0

    [device.x.readout]              # the device as in a device file, below [device]
    ...

Unit, rate and start may be left out where the file states them. What neither says is not guessed.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from pathlib import Path
from types import MappingProxyType
from typing import Any

from recon.readers import read
from recon.readers.contents import Contents, Variable, clock_of, line_up
from scanner.channel import Channel, checked_channel
from scanner.device import Device
from scanner.errors import BadInput
from scanner.files import read_toml
from scanner.hdf5 import check_ends
from scanner.recording import Recording

TEXT_KEYS = ("format", "name", "notes", "acquired")
MAPPING_KEYS = (*TEXT_KEYS, "channels", "device")
CHANNEL_KEYS = ("variable", "unit", "sample_rate", "start", "time", "scale", "offset")

Plan = Mapping[str, Any]


def open_any(path: Path, mapping: Path | Plan | None = None, growing: bool = False) -> Recording:
    """The recording in a file of ours, or, with a mapping, the one that it makes of an instrument's file.

    Nothing is read before it is asked for; close it, or use it in a ``with`` statement. A file of ours may be
    ``growing``, as :meth:`Recording.open` has it.

    Raises:
        BadInput: as :meth:`Recording.open` or :func:`convert`, or as :func:`scanner.hdf5.check_ends`.
    """
    check_ends(path)
    return Recording.open(path, growing) if mapping is None else convert(path, mapping)


def convert_file(source: Path, mapping: Path | Plan, output: Path) -> dict[str, Any]:
    """Write the recording that ``mapping`` makes of ``source``, chunk by chunk; raises as :func:`convert`.

    Returns:
        What was written: ``recording``, ``source``, ``format`` as found, ``duration`` [s], ``device`` (its name or
        None) and, for each of ``channels``, ``variable``, ``unit``, ``sample_rate`` [Hz], ``start`` [s], ``shape``,
        ``stated_by`` (who stated unit, rate and start) and ``overruled`` (what the file states and the mapping denies).
    """
    check_ends(source)
    plan, said_in = _plan(mapping)
    contents = _contents(source, plan, said_in)
    with _recording(contents, source, plan, said_in) as recording:
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
        }


def convert(source: Path, mapping: Path | Plan) -> Recording:
    """The recording that a mapping makes of an instrument's file; it reads from that file when it is asked to.

    Args:
        source: the instrument's file.
        mapping: as above, in a TOML file or as its table.

    Raises:
        BadInput: the file cannot be read, the mapping lacks something or names a variable that the file does not
            hold, or a variable is no signal.
        DeviceInvalid: the mapping's device cannot be used.
        UnitUnknown: the mapping states a unit that does not go with the channel.
    """
    plan, said_in = _plan(mapping)
    return _recording(_contents(source, plan, said_in), source, plan, said_in)


def _plan(mapping: Path | Plan) -> tuple[Plan, object]:
    """The table, and where it stands, for messages."""
    return (mapping, "arguments") if isinstance(mapping, Mapping) else (read_toml(mapping), mapping)


def _contents(source: Path, plan: Plan, said_in: object) -> Contents:
    """What ``source`` holds, once the mapping has been checked as far as it goes without it."""
    if unknown := [key for key in plan if key not in MAPPING_KEYS]:
        raise BadInput("is not a known key", file=said_in, channel=unknown[0], hint=f"known: {', '.join(MAPPING_KEYS)}")
    for key in TEXT_KEYS:
        if not isinstance(plan.get(key, ""), str):
            raise BadInput(f"is {plan[key]!r} and must be text", file=said_in, channel=key, hint="put it in quotes")
    if not isinstance(plan.get("channels"), dict) or not plan["channels"]:
        raise BadInput("names no channels", file=said_in, hint="add a table [channels.<name>] for each")
    if not isinstance(plan.get("device", {}), dict):
        raise BadInput("must be a table", file=said_in, channel="device", hint="write [device.x.readout] and so on")
    return read(source, plan.get("format"))


def _recording(contents: Contents, source: Path, plan: Plan, said_in: object) -> Recording:
    try:
        device = Device.from_table(plan["device"], source=str(said_in)) if "device" in plan else None
        channels = {name: _channel(name, said, contents, source, said_in) for name, said in plan["channels"].items()}
    except BaseException:
        contents.close()
        raise
    attrs = {"name": source.stem, "source": source.name, "source_format": contents.kind} | dict(contents.about)
    attrs |= {key: plan[key] for key in TEXT_KEYS if key in plan and key != "format"}
    text = None if device is None else device.to_toml()
    return Recording(MappingProxyType(channels), MappingProxyType(attrs), None, text, contents)


def _origin(said: Mapping[str, Any], contents: Contents) -> dict[str, Any]:
    """Which variable a channel is, and who stated its unit and clock."""
    stated = {key: getattr(contents.variables[said["variable"]], key) for key in ("unit", "sample_rate", "start")}
    by = {key: "file" if value is not None else "nobody: 0" for key, value in stated.items()}
    by |= {key: "mapping" for key in stated if key in said}
    by |= {key: f"variable {said['time']}" for key in ("sample_rate", "start") if "time" in said}
    scaled = "scale" in said or "offset" in said
    against = {
        key: value
        for key, value in stated.items()
        if key in said and value not in (None, said[key]) and not (scaled and key == "unit")
    }
    return {"variable": said["variable"], "stated_by": by, "overruled": against}


def _channel(name: str, said: Mapping[str, Any], contents: Contents, source: Path, said_in: object) -> Channel:
    def bad(what: str, hint: str) -> BadInput:
        return BadInput(what, file=said_in, channel=f"channels.{name}", hint=hint)

    holds = f"{source.name} holds {listed(contents.variables)}"
    if not isinstance(said, dict):
        raise bad(f"is {said!r} and must be a table", f"write [channels.{name}]")
    if "/" in name or not name.strip(".") or not name.isprintable():
        raise bad("is no name for a channel", "name it without / and control characters")
    if unknown := [key for key in said if key not in CHANNEL_KEYS]:
        raise bad(f"{unknown[0]} is not a known key", f"known: {', '.join(CHANNEL_KEYS)}")
    for key in ("variable", "unit", "time"):
        if not isinstance(said.get(key, ""), str):
            raise bad(f"{key} is {said[key]!r} and must be text", "put it in quotes")
    if "variable" not in said:
        raise bad("says no variable", f"add variable = ...; {holds}")
    for key in {"variable", "time"} & said.keys():
        if said[key] not in contents.variables:
            raise bad(f"there is no variable {said[key]!r}", holds)
    variable = contents.variables[said["variable"]]
    scaled = "scale" in said or "offset" in said
    scale, offset = _number(said.get("scale", 1.0)), _number(said.get("offset", 0.0))
    if not scale or offset is None:
        raise bad("scale must be a number other than 0, offset a number", "channel = scale * variable + offset")
    rate: Any
    if "time" in said:
        if "sample_rate" in said or "start" in said:
            raise bad("says time and sample_rate or start", "the times state both")
        rate, start = _clock(contents.variables[said["time"]], said["time"], bad)
    else:
        rate, start = said.get("sample_rate", variable.sample_rate), said.get("start", variable.start or 0.0)
    unit = said.get("unit", None if scaled else variable.unit)  # the file's unit is that of the numbers before scaling
    for key, value in (("sample_rate", rate), ("unit", unit)):
        if value is None:
            because = f", and the file states none{f' ({variable.note})' if variable.note else ''}"
            raise bad(f"says no {key} of variable {said['variable']!r}{because}", f"add {key} = ...; {holds}")
    file = f"{source} by {said_in}"
    return checked_channel(
        name, line_up(variable.raw), unit=unit, sample_rate=rate, start=start, gain=scale, offset=offset, file=file
    )


def _clock(times: Variable, name: str, bad: Any) -> tuple[float, float]:
    column = line_up(times.raw)
    if not times.is_signal or column.ndim != 1:
        raise bad(f"time = {name!r} is no column of numbers", "name the variable that holds the times [s]")
    rate, start, note = clock_of(column)
    if rate is None or start is None:
        raise bad(f"time = {name!r} is no clock: {note}", "cut the file there, or state sample_rate")
    return rate, start


def listed(variables: Mapping[str, Variable]) -> str:
    """Names and shapes, of the first few where there are many."""
    told = [f"{name} {variable.raw.shape}" for name, variable in variables.items()]
    return ", ".join(told[:20]) + (f" and {len(told) - 20} more" if len(told) > 20 else "")


def _number(value: object) -> float | None:
    if not isinstance(value, (int, float)) or isinstance(value, bool):
        return None
    try:
        return float(value) if isfinite(value) else None
    except OverflowError:  # TOML's integers have no limit, a float has one
        return None
