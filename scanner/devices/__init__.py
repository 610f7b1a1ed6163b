"""The named devices: TOML files in this folder, each with a note on where its values come from."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

from scanner.device import Device
from scanner.errors import BadInput


def names() -> list[str]:
    """Names of the devices that come with the program."""
    return sorted(
        entry.name.removesuffix(".toml") for entry in files(__name__).iterdir() if entry.name.endswith(".toml")
    )


def load(name: str) -> Device:
    """The device of that name.

    Raises:
        BadInput: no such device; the line lists those there are.
    """
    if name not in names():
        raise BadInput(f"no device is named {name!r}", hint=f"there are {', '.join(names())}")
    return Device.from_toml((files(__name__) / f"{name}.toml").read_text(encoding="utf-8"), source=f"device {name}")


def find(source: Device | str | Path) -> Device:
    """Return ``source`` itself if it is a device, else the built-in device of that name, else the device in that file.

    Raises:
        BadInput: there is neither, or the file is not a valid device.
    """
    if isinstance(source, Device):
        return source
    if not isinstance(source, str | Path):
        hint = "give a Device (Device.from_toml makes one of text), the path of a TOML file, or a name"
        raise BadInput(f"is a {type(source).__name__}, no device", channel="device", hint=hint)
    if str(source) in names():
        return load(str(source))
    if "\n" in str(source):
        hint = "Device.from_toml(text) makes a device of it"
        raise BadInput("is the text of a device, neither a name nor the path of a file", channel="device", hint=hint)
    if not Path(source).exists():
        hint = f"there are {', '.join(names())}; `lissajous new-device` writes a file to edit"
        raise BadInput(f"no device is named {str(source)!r} and no file is", channel="device", hint=hint)
    return Device.load(source)
