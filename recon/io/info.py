"""Contents of a recording or an instrument's file, and a mapping to start from."""

from __future__ import annotations

from collections.abc import Collection
from itertools import count
from pathlib import Path
from typing import Any

from recon.io.convert import open_any
from recon.io.readers import read
from recon.io.readers.column_names import TIME_NAMES
from recon.io.readers.contents import Variable
from scanner.channel import AMPLITUDE_CHANNELS, CHANNEL_UNITS
from scanner.hdf5 import attributes, check_ends, is_hdf5, open_hdf5
from scanner.recording_file import FORMAT

HEADING = f"""\
# A suggestion to edit: name each channel by what it is, remove the others, state what is commented out.
# Channels: {", ".join((*CHANNEL_UNITS, *AMPLITUDE_CHANNELS))}, intensity
# (several detectors: variable = ["CH3", "CH4"]). amplitude_x and phase_x of a lock-in also need reference = HZ.
# Times of edges, instead of unit, rate and start: [channels.sync_x], variable = "edges", unit = "us", angle = 0.02
# (rad, of the detector) or event = "both-edges"."""

DEVICE_PART = """\
# The device: remove the first # of each line and edit, or give a file of `lissajous new-device` with --device.
# [device]
# name = "my scanner"
# [device.x.drive]
# kind = "linear"            # or "electrostatic": combs, which move the mirror at half the drive's frequency
# frequency = 2000.0         # Hz, of the drive
# [device.x.readout]         # only with channels sense_x, sense_y: V = gain theta
# kind = "position"
# gain = 20.0                # V / rad
# noise_sd = 0.002           # V
# [device.y.drive]
# kind = "linear"
# frequency = 835.0
# [device.y.readout]
# kind = "position"
# gain = 20.0
# noise_sd = 0.002
# [device.scan]
# half_angle_x = 0.1         # rad, half the field of view
# half_angle_y = 0.1
# angle = "mechanical"       # or "optical"\
"""


def info(path: Path, format: str | None = None, mapping: Path | None = None) -> dict[str, Any]:
    """Variables of a file with size, and unit and clock if stated, and a mapping to start from.

    Args:
        path: the file.
        format: of the file; None detects it.
        mapping: list the recording that it makes of the file instead, see :func:`recon.io.convert.open_any`.

    Returns:
        ``file``, ``format``, ``about`` (name, device, start of the recording, ... as stated), ``variables`` (``shape``,
        ``dtype``, ``unit``, ``sample_rate`` [Hz], ``start`` [s], ``note``; None if not stated) and
        ``suggestion`` (TOML; None for a recording, which needs none).

    Raises:
        BadInput: as :func:`recon.io.readers.read` or :meth:`Recording.open`.
    """
    check_ends(path)
    if mapping is not None or (format is None and _is_recording(path)):
        return _of_recording(path, mapping)
    contents = read(path, format)
    try:
        return {
            "file": str(path),
            "format": contents.kind,
            "about": {key: value for key, value in contents.about.items() if value},
            "variables": {name: _variable_summary(variable) for name, variable in contents.variables.items()},
            "suggestion": suggestion(contents.variables, format),
        }
    finally:
        contents.close()


def suggestion(variables: Any, format: str | None = None) -> str:
    """A mapping (TOML) of all signals; values that the file does not state are commented out, to be filled in."""
    lines, taken = [HEADING, *([f"format = {_quoted(format)}"] if format else [])], set[str]()
    for name, variable in variables.items():
        is_clock = name.rpartition(".")[2].lower() in TIME_NAMES and variable.sample_rate is None
        if not variable.is_signal or variable.raw.shape[0] < 2 or (is_clock and len(variables) > 1):
            continue
        channel = _bare_key(name, taken)
        taken.add(channel)
        lines += ["", f"[channels.{channel}]", f"variable = {_quoted(name)}"]
        lines.append(f"unit = {_quoted(variable.unit)}" if variable.unit else '# unit = "V"')
        if variable.raw.dtype.kind in "iu" and not variable.unit:
            lines.append("# scale = 0.001  # V per count, of counts of a converter")
        rate = variable.sample_rate
        lines.append(f"sample_rate = {float(rate)!r}" if rate else "# sample_rate = 1e6  # Hz")
        lines += [f"start = {float(variable.start)!r}"] if variable.start is not None else []
    return "\n".join([*lines, "", DEVICE_PART])


def _is_recording(path: Path) -> bool:
    if not is_hdf5(path):
        return False
    with open_hdf5(path) as file:
        return attributes(file).get("format") == FORMAT


def _of_recording(path: Path, mapping: Path | None) -> dict[str, Any]:
    with open_any(path, mapping) as recording:
        device = {} if recording.device is None else {"device": recording.device.name}
        return {
            "file": str(path),
            "format": FORMAT,
            "about": {key: str(value) for key, value in recording.attrs.items()} | device,
            "variables": {
                name: {key: getattr(channel, key) for key in ("shape", "unit", "sample_rate", "start")}
                | {"dtype": str(channel.raw.dtype), "note": ""}
                for name, channel in recording.channels.items()
            }
            | {
                name: {"shape": each.times.shape, "unit": "s", "sample_rate": None, "start": None}
                | {"dtype": str(each.times.dtype), "note": f"edges: {each.event}"}
                for name, each in recording.edges.items()
            },
            "suggestion": None,
        }


def _variable_summary(variable: Variable) -> dict[str, Any]:
    statements = {key: getattr(variable, key) for key in ("unit", "sample_rate", "start", "note")}
    return {"shape": variable.raw.shape, "dtype": str(variable.raw.dtype)} | statements


def _bare_key(name: str, taken: Collection[str]) -> str:
    """A key that TOML takes without quotes for a variable, none of ``taken``: other characters become _."""
    key = "".join(c if c.isascii() and (c.isalnum() or c in "_-") else "_" for c in name) or "_"
    free = (f"{key}-{number}" for number in count(2))
    return key if key not in taken else next(each for each in free if each not in taken)


def _quoted(text: str) -> str:
    """Text as TOML writes it."""
    import tomli_w

    return tomli_w.dumps({"_": text}).removeprefix("_ = ").rstrip("\n")
