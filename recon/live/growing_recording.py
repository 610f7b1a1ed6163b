"""Snapshots of a recording that another program is writing."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import h5py
import numpy as np

from recon.io.convert import convert
from scanner.channel import USED_CHANNELS
from scanner.errors import BadInput
from scanner.hdf5 import undamaged
from scanner.recording import Recording

CHECK_INTERVAL_S = 0.001
"""Time between two looks at the size and the time stamp of the file, which take microseconds."""

MAX_POLL_INTERVAL_S = 0.05
"""Longest time between two polls of a file that seems unchanged: its time stamp has steps of some milliseconds, and
mapped memory changes it late."""

FINISHED_ATTRIBUTE = "finished"
"""Attribute of a file by which its writer states that the recording is complete."""


class Snapshot(NamedTuple):
    """The recording up to its current end.

    Attributes:
        recording: open while the snapshot is used.
        ended: reason why the recording is complete; None while further samples may be written.
        read: time at which its end was read [s on the monotonic clock].
    """

    recording: Recording
    ended: str | None
    read: float


def poll_recording(path: Path, mapping: Path | None, quiet_time: float) -> Iterator[Snapshot]:
    """Yield snapshots of a growing file until it ends. Each is closed, or grows, with the next one.

    A file in HDF5's single-writer mode remains open while it grows, because opening it takes milliseconds. Only when it
    has not grown for ``MAX_POLL_INTERVAL_S`` is it opened again, to find whether its writer has closed or replaced it.

    Raises:
        BadInput: the path holds no readable recording for ``quiet_time`` [s].
    """
    last_growth, size, writing = time.monotonic(), -np.inf, False
    recording: Recording | None = None
    try:
        while True:
            state, still_written = _file_state(path), True
            try:
                grown = None if recording is None else _refresh(recording)
                if grown is not None and common_time_span(grown)[1] > size:
                    recording = grown
                elif grown is not None and time.monotonic() - last_growth < MAX_POLL_INTERVAL_S:
                    _wait_for_change(path, state)
                    continue
                else:
                    if recording is not None:
                        recording.close()
                    recording, still_written = _open_growing(path, mapping)
            except BadInput:  # not there yet, or read during a change
                recording = None
                if time.monotonic() - last_growth > quiet_time:
                    raise
                _wait_for_change(path, state)
                continue
            _, end = common_time_span(recording)
            if end > size:
                last_growth, size = time.monotonic(), end
            ended = None
            if writing and not still_written:
                ended = "its writer closed the file"
            elif recording.attrs.get(FINISHED_ATTRIBUTE):
                ended = "the file says that it is finished"
            elif time.monotonic() - last_growth > quiet_time:
                ended = f"nothing came for {quiet_time:g} s"
            yield Snapshot(recording, ended, time.monotonic())
            if ended:
                return
            writing = still_written
            _wait_for_change(path, state)
    finally:
        if recording is not None:
            recording.close()


def common_time_span(recording: Recording) -> tuple[float, float]:
    """Return begin and end [s] of the time that all channels in use cover; all channels where none has a known name.

    A room's temperature, of a few samples, does not end the scan.
    """
    known = {*USED_CHANNELS, *(channel.reference for channel in recording.channels.values())}
    channels = [channel for name, channel in recording.channels.items() if name in known]
    channels = channels or list(recording.channels.values())
    return max(channel.start for channel in channels), min(channel.end for channel in channels)


def _refresh(recording: Recording) -> Recording | None:
    """The recording with what another program has written to its datasets since; None if it has to be opened again."""
    channels = {}
    for name, channel in recording.channels.items():
        if not isinstance(channel.raw, h5py.Dataset) or channel.first or not channel.raw.file.swmr_mode:
            return None
        with undamaged(recording.path, name):
            channel.raw.refresh()
            channels[name] = replace(channel, stop=channel.raw.shape[0])
    return None if recording.edges else replace(recording, channels=MappingProxyType(channels))


def _file_state(path: Path) -> tuple[int, int] | None:
    """Size [bytes] and time of the last change [ns] of a file; None if there is none."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_size, status.st_mtime_ns


def _wait_for_change(path: Path, state: tuple[int, int] | None) -> None:
    """Wait until a file differs from ``state``, but no longer than ``MAX_POLL_INTERVAL_S``."""
    latest = time.monotonic() + MAX_POLL_INTERVAL_S
    while _file_state(path) == state and time.monotonic() < latest:
        time.sleep(CHECK_INTERVAL_S)


def _open_growing(path: Path, mapping: Path | None) -> tuple[Recording, bool]:
    """The recording up to its current end, and whether another program has it open for writing."""
    try:
        return (Recording.open(path) if mapping is None else convert(path, mapping)), False
    except BadInput:
        if mapping is not None:
            raise
        return Recording.open(path, growing=True), True
