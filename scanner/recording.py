"""The recording: the signals of a scanner, read from one HDF5 file or given as arrays.

A recording is lazy (opening reads no samples) and immutable (slicing gives a new one over the same file). The true
values of a simulation, ``/truth``, are not part of it: :func:`scanner.truth.read_truth` reads them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Any, Protocol

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray

from scanner.arguments import check_numbers
from scanner.channel import USED_CHANNELS, Channel, make_channel
from scanner.channel_names import list_names
from scanner.device import Device
from scanner.devices import find
from scanner.edges import EDGE_CHANNELS, Edges, make_edges
from scanner.errors import BadInput, ChannelMissing
from scanner.files import replacing
from scanner.hdf5 import attributes, child, new_hdf5, open_hdf5, undamaged
from scanner.recording_file import (
    FORMAT,
    VERSIONS,
    check_format,
    check_texts,
    device_text,
    open_channel,
    open_edges,
    write_channel,
)
from scanner.truth import Truth, write_truth
from scanner.wording import counted


class Closeable(Protocol):
    """The open file that the channels of a recording read from."""

    def close(self) -> None: ...


@dataclass(frozen=True, eq=False)
class Recording:
    """Channels with units and clocks, and the nominal device. Made by :meth:`open` or :meth:`from_arrays`.

    Attributes:
        channels: by name.
        attrs: attributes of the file (``name``, ``notes``, ``acquired``, ...).
        path: of the file, None for a recording in memory.
        device_toml: the nominal device as text, None where there is none.
        edges: edge times of the detectors that the beam crosses (``sync_x``, ``sync_y``), by name.
    """

    channels: Mapping[str, Channel]
    attrs: Mapping[str, Any] = field(default_factory=dict)
    path: Path | None = None
    device_toml: str | None = None
    _file: Closeable | None = None
    edges: Mapping[str, Edges] = field(default_factory=dict)
    _origin: float | None = None

    @classmethod
    def open(cls, path: str | Path, growing: bool = False) -> Recording:
        """Return the recording in an HDF5 file. Close it, or use it in a ``with`` statement.

        Args:
            path: of the file.
            growing: another program may be writing the file; the recording is what it has written so far.

        Raises:
            BadInput: no such file, no HDF5, truncated, another format or version, a name that is no text, no channels,
                or a channel that :func:`scanner.channel.make_channel` refuses. Links and storage outside the file are
                refused too.
        """
        path = Path(path)
        file = open_hdf5(path, growing)
        try:
            with undamaged(path):
                attrs = attributes(file)
                check_format(attrs.pop("format", None), attrs.pop("version", None), path)
                check_texts(attrs, path)
                group = child(file, "channels", h5py.Group)
                if group is None or not len(group):
                    raise BadInput("holds no channels", file=path, hint="store signals under /channels")
                channels = {name: open_channel(group, name, path) for name in group if name not in EDGE_CHANNELS}
                edges = {name: open_edges(group, name, path) for name in group if name in EDGE_CHANNELS}
                text = device_text(file, path)
        except BaseException:
            file.close()
            raise
        return cls(MappingProxyType(channels), MappingProxyType(attrs), path, text, file, MappingProxyType(edges))

    @classmethod
    def from_arrays(
        cls,
        channels: Mapping[str, tuple[Any, ...]],
        device: Device | str | Path | None = None,
        name: str | None = None,
        detectors: Sequence[str] = (),
        **attrs: Any,
    ) -> Recording:
        """Return a recording in memory.

        Example::

            volts = np.load("sense.npy")  # shape (n,), sampled at 5 MHz
            channels = {"sense_x": (volts, "V", 5e6), "drive_x": (drive, "V", 1e6, 0.002)}  # the drive starts at 2 ms
            recording = Recording.from_arrays(channels, device)

        Args:
            channels: name -> (values, unit, sample rate [Hz]) or (values, unit, sample rate [Hz], start [s]). Values
                have the shape (n,), or (n, detectors) for ``intensity``; start is the time of the first sample, 0
                where it is left out. Channels may differ in sample rate, start and length. ``sync_x`` and ``sync_y``
                are (edge times, unit, attributes), as ``(times, "s", {"event": "both-edges", "angle": 0.01})``. After
                start, ``amplitude_x`` and ``phase_x`` may have {"reference": ..., "level": ...} as well.
            device: the nominal device, the name of one that comes with the program, or the path of a device file.
            name: of the recording.
            detectors: names of the columns of ``intensity``.
            attrs: further attributes of the recording (``notes``, ``acquired``).

        Raises:
            BadInput: no channels, a channel that is not such a tuple, or one that
                :func:`scanner.channel.make_channel` refuses: values of another shape, an unknown unit, no clock.
        """
        if not channels:
            raise BadInput("holds no channels", hint="give at least one")
        made, edges = {}, {}
        for key, channel in channels.items():
            if key in EDGE_CHANNELS:
                edges[key] = _edges_from_tuple(key, channel)
                continue
            if not isinstance(channel, tuple) or len(channel) not in (3, 4, 5):
                raise BadInput(
                    "is not a tuple of 3 or 4 items", channel=key, hint="give (values, unit, sample rate[, start])"
                )
            stated = channel[-1] if isinstance(channel[-1], Mapping) else {}
            values, unit, sample_rate, *start = channel[: len(channel) - bool(stated)]
            raw = _as_numbers(values, key).view()
            raw.flags.writeable = False
            first, names = start[0] if start else 0.0, detectors if key == "intensity" else ()
            made[key] = make_channel(
                key, raw, unit=unit, sample_rate=sample_rate, start=first, detectors=names, **stated
            )
        attrs = ({} if name is None else {"name": name}) | attrs
        text = None if device is None else find(device).to_toml()
        return cls(MappingProxyType(made), MappingProxyType(attrs), device_toml=text, edges=MappingProxyType(edges))

    def __reduce__(self) -> tuple[Callable[..., Recording], tuple[object, ...]]:
        """For pickle and copy: the arrays of a recording in memory.

        Raises:
            BadInput: the channels are read from an open file.
        """
        if self._file is not None:
            what = "cannot be pickled: its channels are read from an open file"
            raise BadInput(what, file=self.path, hint="pass the path, and open it there")
        return _from_pickle, (dict(self.channels), dict(self.attrs), self.path, self.device_toml, dict(self.edges))

    def __repr__(self) -> str:
        device = "no device" if self.device_toml is None else "with a device"
        lines = [f"Recording {self.name!r}: {self.duration:.6g} s from {self.start:.6g} s, {device}"]
        lines += [
            f"  {channel.name}: {' x '.join(map(str, channel.shape))} samples [{channel.unit}] "
            f"at {channel.sample_rate:.9g} Hz from {channel.start:.6g} s"
            for channel in self.channels.values()
        ]
        lines += [
            f"  {edges.name}: {counted(edges.times.size, 'edge')}, {edges.event}" for edges in self.edges.values()
        ]
        return "\n".join(lines)

    def __enter__(self) -> Recording:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file. Channels of this recording and of its slices can then no longer be read."""
        if self._file is not None:
            self._file.close()

    def __contains__(self, name: object) -> bool:
        return name in self.channels

    def __getitem__(self, name: str) -> Channel:
        return self.require(name)

    @property
    def names(self) -> list[str]:
        """Names of all channels, those of edge times last."""
        return [*self.channels, *self.edges]

    def require(self, name: str, why: str | None = None) -> Channel:
        """Return a channel.

        Args:
            name: of the channel.
            why: what it is needed for, for the message.

        Raises:
            ChannelMissing: it is not in the recording; the message lists the channels.
        """
        if name not in self.channels:
            what = "is not in the recording" + (f" and {why}" if why else "")
            hint = f"it holds {list_names(self.names)}"
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
        """Name that the recording states, else the name of its file."""
        return str(self.attrs.get("name") or (self.path.stem if self.path else "recording"))

    @property
    def notes(self) -> str:
        """Notes that the recording states, else an empty text."""
        return str(self.attrs.get("notes", ""))

    @property
    def start(self) -> float:
        """Time of the first sample of any channel in use [s]; of the first edge where there are edges only."""
        starts = [channel.start for channel in self._channels_in_use()]
        return min(starts or [float(edges.times[0]) for edges in self._edges_in_use()])

    @property
    def origin(self) -> float:
        """Time from which drifts and phases of a device's terms count [s]: the start, or that of the whole of
        a part."""
        return self.start if self._origin is None else self._origin

    @property
    def end(self) -> float:
        """Time one sample after the last sample of any channel in use [s]; of the last edge with edges only."""
        ends = [channel.end for channel in self._channels_in_use()]
        return max(ends or [float(edges.times[-1]) for edges in self._edges_in_use()])

    @property
    def duration(self) -> float:
        """From the first sample of any channel in use to the end [s]."""
        return self.end - self.start

    def _channels_in_use(self) -> list[Channel]:
        """The channels whose names have a meaning; all where there are neither such channels nor edges.

        A room's temperature or a trigger may be recorded for longer than the scan.
        """
        known = [channel for name, channel in self.channels.items() if name in USED_CHANNELS]
        return known if known or self._edges_in_use() else list(self.channels.values())

    def _edges_in_use(self) -> list[Edges]:
        """The lists that hold an edge."""
        return [edges for edges in self.edges.values() if edges.times.size]

    def slice(self, t0: float, t1: float) -> Recording:
        """Return the samples with ``t0 <= t < t1`` [s], on the same clock, without channels that have none.

        It is a recording by itself: drifts of a device begin at its start.

        Raises:
            BadInput: the interval holds no sample of any channel, or a limit is no number.
        """
        check_numbers(t0=t0, t1=t1)
        cuts = {name: _cut(channel, t0, t1) for name, channel in self.channels.items()}
        nonempty = {name: channel for name, channel in cuts.items() if channel.size and t0 < t1}  # False of NaN
        if not nonempty:
            what = f"holds nothing from {t0:g} s to {t1:g} s"
            raise BadInput(what, file=self.path, hint=f"it runs from {self.start:g} s to {self.end:g} s")
        edges = {name: each.between(t0, t1) for name, each in self.edges.items()}
        return replace(self, channels=MappingProxyType(nonempty), edges=MappingProxyType(edges), _origin=None)

    def part(self, t0: float, t1: float) -> Recording:
        """Return :meth:`slice` with the origin of the whole, so that a drift of the device continues in it."""
        return replace(self.slice(t0, t1), _origin=self.origin)

    def without_channel(self, name: str) -> Recording:
        """Return the recording without a channel, with the same origin."""
        rest = {key: channel for key, channel in self.channels.items() if key != name}
        return replace(self, channels=MappingProxyType(rest), _origin=self.origin)

    def with_channel(self, channel: Channel) -> Recording:
        """Return the recording with a channel added, or replaced where there is one of its name."""
        return replace(self, channels=MappingProxyType({**self.channels, channel.name: channel}))

    def write(self, path: str | Path, truth: Truth | None = None) -> None:
        """Write a file that :meth:`open` reads. It appears at ``path`` when it is complete.

        Integer samples are stored as integers with gain and offset, others in the unit in which they are read.

        Args:
            path: of the new file.
            truth: of a simulation, see :func:`scanner.truth.write_truth`.
        """
        with replacing(path) as beside, new_hdf5(beside) as file:
            file.attrs.update({**self.attrs, "format": FORMAT, "version": VERSIONS[-1]})
            group = file.create_group("channels")
            for channel in self.channels.values():
                write_channel(group, channel)
            for edges in self.edges.values():
                group.create_dataset(edges.name, data=edges.times).attrs.update(edges.attributes)
            if self.device_toml is not None:
                file.create_group("device").attrs["toml"] = self.device_toml
            if truth is not None:
                write_truth(file.create_group("truth"), truth)


def _from_pickle(
    channels: dict[str, Channel], attrs: dict[str, Any], path: Path | None, text: str | None, edges: dict[str, Edges]
) -> Recording:
    """The recording of which :meth:`Recording.__reduce__` returned the parts."""
    return Recording(MappingProxyType(channels), MappingProxyType(attrs), path, text, edges=MappingProxyType(edges))


def _edges_from_tuple(name: str, given: object) -> Edges:
    if not isinstance(given, tuple) or len(given) != 3 or not isinstance(given[2], Mapping):
        hint = 'give (times, "s", {"event": "both-edges"})'
        raise BadInput("is not a tuple of times, unit and attributes", channel=name, hint=hint)
    return make_edges(name, _as_numbers(given[0], name), {"unit": given[1], **given[2]})


def _as_numbers(values: ArrayLike, name: str) -> NDArray[Any]:
    """The values as an array, masked ones as NaN; BadInput where rows differ in length, so that they form none."""
    try:
        return np.ma.filled(np.ma.array(values, float), np.nan) if np.ma.is_masked(values) else np.asarray(values)
    except ValueError:
        raise BadInput("is no array: its rows differ in length", channel=name, hint="give shape (n,)") from None


def _cut(channel: Channel, t0: float, t1: float) -> Channel:
    low = channel.sample_from(t0)
    high = max(channel.sample_from(t1), low)
    start = channel.start + low / channel.sample_rate
    return replace(channel, start=start, first=channel.first + low, stop=channel.first + high)
