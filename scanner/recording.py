"""The recording: one front door for the files that hold a scanner's signals.

A recording is lazy (opening reads no samples) and immutable (slicing gives a new one over the same file).
What a simulation knows beyond its signals, ``/truth``, is not part of it: :func:`scanner.truth.read_truth` reads that.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import ceil, isfinite
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Any, Protocol

import h5py
import numpy as np
from numpy.typing import ArrayLike

from scanner.channel import CHUNK, Channel, checked_channel
from scanner.device import Device
from scanner.errors import BadInput, ChannelMissing
from scanner.files import replacing
from scanner.hdf5 import attributes, child, new_hdf5, open_hdf5, undamaged
from scanner.truth import Truth, write_truth

FORMAT = "lissajous-recording"
VERSIONS = (1,)

# A sample that rounding has put this fraction of a sample before a cut still belongs behind it.
_ROUNDING = 1e-6


class Closeable(Protocol):
    """The open file that the channels of a recording read from."""

    def close(self) -> None: ...


@dataclass(frozen=True, eq=False)
class Recording:
    """Channels with units and clocks, and the nominal device. Made by :meth:`open` or :meth:`from_arrays`.

    Attributes:
        channels: by name.
        attrs: what the file says of itself (``name``, ``notes``, ``acquired``, ...).
        path: of the file, None for a recording in memory.
        device_toml: the nominal device as text, None where there is none.
    """

    channels: Mapping[str, Channel]
    attrs: Mapping[str, Any] = field(default_factory=dict)
    path: Path | None = None
    device_toml: str | None = None
    _file: Closeable | None = None

    @classmethod
    def open(cls, path: str | Path, growing: bool = False) -> Recording:
        """The recording in an HDF5 file; close it, or use it in a ``with`` statement.

        Args:
            path: of the file.
            growing: another program may be writing it; what it has written by now is the recording.

        Raises:
            BadInput: no such file, no HDF5, truncated, another format or version, no channels, or a channel that
                :func:`scanner.channel.checked_channel` refuses. Links and storage outside the file are refused too.
        """
        path = Path(path)
        file = open_hdf5(path, growing)
        try:
            with undamaged(path):
                attrs = attributes(file)
                _check_format(attrs.pop("format", None), attrs.pop("version", None), path)
                group = child(file, "channels", h5py.Group)
                if group is None or not len(group):
                    raise BadInput("holds no channels", file=path, hint="store signals under /channels")
                channels = {name: _open_channel(group, name, path) for name in group}
                text = _device_text(file, path)
        except BaseException:
            file.close()
            raise
        return cls(MappingProxyType(channels), MappingProxyType(attrs), path, text, file)

    @classmethod
    def from_arrays(
        cls,
        channels: Mapping[str, tuple[ArrayLike, str, float, float]],
        device: Device | None = None,
        name: str | None = None,
        **attrs: Any,
    ) -> Recording:
        """A recording in memory.

        Args:
            channels: name -> (values, unit, sample rate [Hz], start [s]).
            device: the nominal device.
            name: of the recording.
            attrs: more of what a file would say of itself (``notes``, ``acquired``).

        Raises:
            BadInput: no channels, or a channel that :func:`scanner.channel.checked_channel` refuses.
        """
        if not channels:
            raise BadInput("holds no channels", hint="give at least one")
        made = {}
        for key, (values, unit, sample_rate, start) in channels.items():
            raw = np.asarray(values).view()
            raw.flags.writeable = False
            made[key] = checked_channel(key, raw, unit=unit, sample_rate=sample_rate, start=start)
        attrs = ({} if name is None else {"name": name}) | attrs
        text = None if device is None else device.to_toml()
        return cls(MappingProxyType(made), MappingProxyType(attrs), device_toml=text)

    def __enter__(self) -> Recording:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file; channels not read by then, those of slices too, can no longer be read."""
        if self._file is not None:
            self._file.close()

    def __contains__(self, name: object) -> bool:
        return name in self.channels

    def __getitem__(self, name: str) -> Channel:
        return self.require(name)

    def require(self, name: str, why: str | None = None) -> Channel:
        """The channel ``name``; ``why`` says who needs it, for the message.

        Raises:
            ChannelMissing: with the channels that there are.
        """
        if name not in self.channels:
            what = "is not in the recording" + (f" and {why}" if why else "")
            hint = f"it holds {', '.join(sorted(self.channels))}"
            raise ChannelMissing(what, file=self.path, channel=name, hint=hint)
        return self.channels[name]

    @cached_property
    def device(self) -> Device | None:
        """The nominal device, None where the recording states none.

        Raises:
            DeviceInvalid: the recording states one that cannot be used.
        """
        if self.device_toml is None:
            return None
        return Device.from_toml(self.device_toml, source=None if self.path is None else str(self.path))

    @property
    def name(self) -> str:
        """What the recording calls itself, else its file's name."""
        return str(self.attrs.get("name") or (self.path.stem if self.path else "recording"))

    @property
    def notes(self) -> str:
        """What was noted with it, else nothing."""
        return str(self.attrs.get("notes", ""))

    @property
    def start(self) -> float:
        """Time of the first sample of any channel [s]."""
        return min(channel.start for channel in self.channels.values())

    @property
    def end(self) -> float:
        """One sample after the last one of the channel that goes on longest [s]."""
        return max(channel.end for channel in self.channels.values())

    @property
    def duration(self) -> float:
        """From the first sample of any channel to the end [s]."""
        return self.end - self.start

    def slice(self, t0: float, t1: float) -> Recording:
        """The samples with ``t0 <= t < t1`` [s], on the same clock; a channel with none of them is left out.

        Raises:
            BadInput: the interval holds no sample of any channel.
        """
        cuts = {name: _cut(channel, t0, t1) for name, channel in self.channels.items()}
        kept = {name: channel for name, channel in cuts.items() if channel.size}
        if not kept:
            what = f"holds nothing from {t0:g} s to {t1:g} s"
            raise BadInput(what, file=self.path, hint=f"it runs from {self.start:g} s to {self.end:g} s")
        return replace(self, channels=MappingProxyType(kept))

    def write(self, path: str | Path, truth: Truth | None = None) -> None:
        """Write a file that :meth:`open` reads; it appears at ``path`` when it is complete.

        Integer samples stay integers, with their gain and offset; others are stored in the unit they are read in.

        Args:
            path: of the new file.
            truth: of a simulation, see :func:`scanner.truth.write_truth`.
        """
        with replacing(path) as beside, new_hdf5(beside) as file:
            file.attrs.update({**self.attrs, "format": FORMAT, "version": VERSIONS[-1]})
            group = file.create_group("channels")
            for each in self.channels.values():
                _write_channel(group, each)
            if self.device_toml is not None:
                file.create_group("device").attrs["toml"] = self.device_toml
            if truth is not None:
                write_truth(file.create_group("truth"), truth)


def _check_format(name: object, version: object, path: Path) -> None:
    if name != FORMAT:
        what = "states no format" if name is None else f"is of format {name!r}"
        hint = f"a recording has the attribute format = {FORMAT!r}; make one with `lissajous convert`"
        raise BadInput(what, file=path, hint=hint)
    if version not in VERSIONS:
        what = "states no version" if version is None else f"is a recording of version {version!r}"
        raise BadInput(what, file=path, hint=f"versions read here: {', '.join(map(str, VERSIONS))}")


def _device_text(file: h5py.File, path: Path) -> str | None:
    group = child(file, "device", h5py.Group)
    text = None if group is None else attributes(group).get("toml")
    if text is not None and not isinstance(text, str):
        raise BadInput("attribute toml is not text", file=path, channel="/device", hint="store the device as TOML text")
    return text


def _open_channel(group: h5py.Group, name: str, path: Path) -> Channel:
    dataset = child(group, name, h5py.Dataset)
    if dataset is None:
        raise BadInput("is listed and not there", file=path, channel=name, hint="copy the file again")
    known = attributes(dataset)
    needed = {key: known.get(key) for key in ("unit", "sample_rate")}
    said = {key: known[key] for key in ("start", "gain", "offset") if key in known}
    return checked_channel(name, dataset, file=str(path), **needed, **said)


def _cut(channel: Channel, t0: float, t1: float) -> Channel:
    def index(t: float) -> int:
        samples = (t - channel.start) * channel.sample_rate - _ROUNDING
        return min(max(ceil(samples), 0), channel.size) if isfinite(samples) else (0 if samples < 0 else channel.size)

    low = index(t0)
    high = max(index(t1), low)
    start = channel.start + low / channel.sample_rate
    return replace(channel, start=start, first=channel.first + low, stop=channel.first + high)


def _write_channel(group: h5py.Group, channel: Channel) -> None:
    whole = channel.raw.dtype.kind in "iu"
    plain = channel.gain == 1.0 and channel.offset == 0.0
    dtype = channel.raw.dtype if whole or plain else np.float64
    dataset = group.create_dataset(channel.name, channel.shape, dtype)
    for first in range(0, channel.size, CHUNK):
        stop = min(first + CHUNK, channel.size)
        if whole or plain:
            dataset[first:stop] = channel.raw[channel.first + first : channel.first + stop]
        else:
            dataset[first:stop] = channel.read(first, stop)
    dataset.attrs.update({"unit": channel.unit, "sample_rate": channel.sample_rate, "start": channel.start})
    if whole and not plain:
        dataset.attrs.update({"gain": channel.gain, "offset": channel.offset})
