"""The parts of a recording's HDF5 file: its attributes, channels, edges and device, read with checks and written."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from scanner.channel import READ_CHUNK_SAMPLES, Channel, make_channel
from scanner.edges import Edges, make_edges
from scanner.errors import BadInput
from scanner.hdf5 import attributes, child

FORMAT = "lissajous-recording"
VERSIONS = (1,)
TEXT_ATTRIBUTES = ("name", "notes", "acquired")
"""Attributes of the file that are texts; a number is accepted as one."""


def open_edges(group: h5py.Group, name: str, path: Path) -> Edges:
    """Return the edge times in a dataset of ``/channels``; BadInput where it is damaged."""
    dataset = child(group, name, h5py.Dataset)
    if dataset is None:
        raise BadInput("is listed and not there", file=path, channel=name, hint="copy the file again")
    return make_edges(name, dataset[...], attributes(dataset), str(path))


def check_format(name: object, version: object, path: Path) -> None:
    """Check that a file states the format and a version that is read; BadInput otherwise."""
    if name != FORMAT:
        what = "states no format" if name is None else f"is of format {name!r}"
        hint = f"a recording has the attribute format = {FORMAT!r}; make one with `lissajous convert`"
        raise BadInput(what, file=path, hint=hint)
    if version not in VERSIONS:
        what = "states no version" if version is None else f"is a recording of version {version!r}"
        raise BadInput(what, file=path, hint=f"versions read here: {', '.join(map(str, VERSIONS))}")


def check_texts(attrs: Mapping[str, Any], path: Path) -> None:
    """Check that attributes that describe the recording are texts; BadInput otherwise."""
    for key in TEXT_ATTRIBUTES:
        if not isinstance(attrs.get(key, ""), (str, int, float)):
            hint = f"store {key} as one text, or remove it"
            raise BadInput(f"attribute {key} is {type(attrs[key]).__name__}, not text", file=path, hint=hint)


def device_text(file: h5py.File, path: Path) -> str | None:
    """Return the nominal device as TOML text; None where there is none, BadInput where it is no text."""
    group = child(file, "device", h5py.Group)
    text = None if group is None else attributes(group).get("toml")
    if text is not None and not isinstance(text, str):
        raise BadInput("attribute toml is not text", file=path, channel="/device", hint="store the device as TOML text")
    return text


def open_channel(group: h5py.Group, name: str, path: Path) -> Channel:
    """Return the channel in a dataset of ``/channels``; no sample is read. Raises as ``make_channel``."""
    dataset = child(group, name, h5py.Dataset)
    if dataset is None:
        raise BadInput("is listed and not there", file=path, channel=name, hint="copy the file again")
    stated = attributes(dataset)
    required = {key: stated.get(key) for key in ("unit", "sample_rate")}
    optional = {
        key: stated[key] for key in ("start", "gain", "offset", "detectors", "reference", "level") if key in stated
    }
    return make_channel(name, dataset, file=str(path), **required, **optional)


def write_channel(group: h5py.Group, channel: Channel) -> None:
    """Write a channel: integers with gain and offset, other samples in the unit in which they are read."""
    whole = channel.raw.dtype.kind in "iu"
    plain = channel.gain == 1.0 and channel.offset == 0.0
    dtype = channel.raw.dtype if whole or plain else np.float64
    dataset = group.create_dataset(channel.name, channel.shape, dtype)
    for first in range(0, channel.size, READ_CHUNK_SAMPLES):
        stop = min(first + READ_CHUNK_SAMPLES, channel.size)
        if whole or plain:
            dataset[first:stop] = channel.raw[channel.first + first : channel.first + stop]
        else:
            dataset[first:stop] = channel.read(first, stop)
    dataset.attrs.update({"unit": channel.unit, "sample_rate": channel.sample_rate, "start": channel.start})
    if channel.reference is not None:
        dataset.attrs["reference"] = channel.reference
    if channel.detectors:
        dataset.attrs["detectors"] = list(channel.detectors)
    if whole and not plain:
        dataset.attrs.update({"gain": channel.gain, "offset": channel.offset})
