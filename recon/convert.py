"""An instrument's file as a recording, by a mapping (TOML) that says what each of its variables is.

A mapping names the file's format, and for each channel the variable, its unit and its clock; it may carry the device::

    format = "matlab"               # MATLAB 5 to 7.2
    name = "afm-spiral"

    [channels.sense_x]
    variable = "x"
    unit = "V"                      # after scaling
    sample_rate = 20000.0           # Hz
    start = 0.0                     # s, 0 where it is not said
    scale = 1.0                     # channel = scale * variable + offset
    offset = 0.0

    [device.x.readout]              # the device as in a device file, below [device]
    ...

What the mapping does not say is not guessed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.device import Device
from scanner.errors import BadInput
from scanner.files import read_toml
from scanner.recording import Recording

Variables = dict[str, NDArray[Any]]

MAPPING_KEYS = ("format", "name", "notes", "acquired", "channels", "device")
NEEDED = ("variable", "unit", "sample_rate")
CHANNEL_KEYS = (*NEEDED, "start", "scale", "offset")


def convert_file(source: Path, mapping: Path, output: Path) -> dict[str, Any]:
    """Write the recording that ``mapping`` makes of ``source``; raises as :func:`convert`.

    Returns:
        What was written: ``recording``, ``source``, ``duration`` [s], ``device`` (its name or None) and, for each of
        ``channels``, ``unit``, ``sample_rate`` [Hz], ``start`` [s] and ``shape``.
    """
    recording = convert(source, mapping)
    recording.write(output)
    return {
        "recording": str(output),
        "source": str(source),
        "duration": recording.duration,
        "device": None if recording.device is None else recording.device.name,
        "channels": {
            name: {key: getattr(channel, key) for key in ("unit", "sample_rate", "start", "shape")}
            for name, channel in recording.channels.items()
        },
    }


def convert(source: Path, mapping: Path) -> Recording:
    """The recording that a mapping makes of an instrument's file.

    Args:
        source: the instrument's file.
        mapping: TOML file, as above.

    Raises:
        BadInput: either file cannot be read, the mapping lacks something or names a variable that the file does not
            hold, or a variable is no signal.
        DeviceInvalid: the mapping's device cannot be used.
        UnitUnknown: the mapping states a unit that does not go with the channel.
    """
    plan = read_toml(mapping)
    if unknown := [key for key in plan if key not in MAPPING_KEYS]:
        raise BadInput("is not a known key", file=mapping, channel=unknown[0], hint=f"known: {', '.join(MAPPING_KEYS)}")
    wanted, device = plan.get("channels"), plan.get("device")
    if not isinstance(wanted, dict) or not wanted:
        raise BadInput("names no channels", file=mapping, hint="add a table [channels.<name>] for each")
    if device is not None:
        if not isinstance(device, dict):
            raise BadInput("must be a table", file=mapping, channel="device", hint="write [device.x.readout] and so on")
        device = Device.from_table(device, source=str(mapping))
    variables = _reader(plan.get("format"), mapping)(source)
    channels = {name: _channel(name, said, variables, source, mapping) for name, said in wanted.items()}
    attrs = {key: plan[key] for key in ("notes", "acquired") if key in plan}
    try:
        return Recording.from_arrays(channels, device, plan.get("name", source.stem), **attrs)
    except BadInput as error:
        error.file = f"{source} by {mapping}"
        raise


def read_matlab(path: Path) -> Variables:
    """Variables of a MATLAB file, version 4 to 7.2; an (n, 1) or (1, n) matrix, MATLAB's vector, as (n,).

    Raises:
        BadInput: no such file, no MATLAB file, a damaged one, or one of version 7.3.
    """
    from scipy.io import loadmat

    if not path.is_file():
        raise BadInput("no such file", file=path, hint="name the instrument's file")
    try:
        content = loadmat(path)
    except NotImplementedError:
        hint = "save it with the option -v7 in MATLAB"
        raise BadInput("is a MATLAB 7.3 file, which is not read yet", file=path, hint=hint) from None
    except Exception as error:  # the parser stumbles in as many ways as a file can be damaged
        raise BadInput(f"is not a whole MATLAB file: {error}", file=path, hint="copy or save it again") from None
    return {name: _vector(value) for name, value in content.items() if not name.startswith("__")}


READERS: dict[str, Callable[[Path], Variables]] = {"matlab": read_matlab}


def _reader(name: object, mapping: Path) -> Callable[[Path], Variables]:
    if name not in READERS:
        what = "states no format" if name is None else f"format {name!r} is unknown"
        raise BadInput(what, file=mapping, channel="format", hint=f"known formats: {', '.join(READERS)}")
    return READERS[str(name)]


def _vector(value: NDArray[Any]) -> NDArray[Any]:
    return value.reshape(-1) if value.ndim == 2 and 1 in value.shape else value


def _channel(
    name: str, said: Mapping[str, Any], variables: Variables, source: Path, mapping: Path
) -> tuple[NDArray[Any], str, float, float]:
    """What :meth:`Recording.from_arrays` takes for one channel."""
    holds = f"{source.name} holds {', '.join(f'{key} {value.shape}' for key, value in variables.items()) or 'nothing'}"

    def bad(what: str, hint: str) -> BadInput:
        return BadInput(what, file=mapping, channel=f"channels.{name}", hint=hint)

    if not isinstance(said, dict):
        raise bad(f"is {said!r} and must be a table", f"write [channels.{name}]")
    if unknown := [key for key in said if key not in CHANNEL_KEYS]:
        raise bad(f"{unknown[0]} is not a known key", f"known: {', '.join(CHANNEL_KEYS)}")
    for key in NEEDED:
        if key not in said:
            of = f" of variable {said['variable']!r}" if "variable" in said else ""
            raise bad(f"says no {key}{of}", f"add {key} = ...; {holds}")
    for key in ("variable", "unit"):
        if not isinstance(said[key], str):
            raise bad(f"{key} is {said[key]!r} and must be text", "put it in quotes")
    if said["variable"] not in variables:
        raise bad(f"there is no variable {said['variable']!r}", holds)
    values = variables[said["variable"]]
    if "scale" in said or "offset" in said:
        scale, offset = _number(said.get("scale", 1.0)), _number(said.get("offset", 0.0))
        if not scale or offset is None:
            raise bad("scale must be a number other than 0, offset a number", "channel = scale * variable + offset")
        if values.dtype.kind in "iuf":
            values = scale * values.astype(np.float64) + offset
    return values, said["unit"], said["sample_rate"], said.get("start", 0.0)


def _number(value: object) -> float | None:
    number = isinstance(value, (int, float)) and not isinstance(value, bool) and isfinite(value)
    return float(value) if number else None  # type: ignore[arg-type]
