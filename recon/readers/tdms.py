"""NI TDMS through nptdms (extra ``tdms``), read slice by slice."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.readers.contents import Contents, Variable, rate_of, spelled, unique
from scanner.channel import Lazy
from scanner.errors import BadInput
from scanner.files import check_claim

# LabVIEW's zero of time, which stands where a waveform has no absolute start.
EPOCH = np.datetime64("1904-01-01T00:00:00")
SECOND = np.timedelta64(1, "s")


def read_tdms(path: Path) -> Contents:
    """Channels of a TDMS file by ``group/channel``, scaled as the file says, on a clock of the earliest start.

    Raises:
        BadInput: nptdms is not installed, or the file is damaged.
    """
    try:
        from nptdms import TdmsFile
        from nptdms.log import log_manager
    except ImportError:
        hint = "pip install 'lissajous[tdms]'"
        raise BadInput("reading TDMS needs the package nptdms", file=path, hint=hint) from None
    log_manager.set_level(logging.ERROR)  # what it warns of stands in the notes
    with _parsing(path):
        file = TdmsFile.open(path)
        note = "the file's last part is incomplete" if file.file_status.incomplete_final_segment else ""
        channels = [channel for group in file.groups() for channel in group.channels()]
        for item in (file, *file.groups(), *channels):
            _check_scales(item.properties)
        names = unique(f"{channel.group_name}/{channel.name}" for channel in channels)
        begun = [_absolute(channel.properties.get("wf_start_time")) for channel in channels]
        zero = min((time for time in begun if time is not None), default=None)
        variables = {
            name: _variable(path, channel, note, 0.0 if time is None else float((time - zero) / SECOND))
            for name, channel, time in zip(names, channels, begun, strict=True)
        }
    about = {} if zero is None else {"acquired": f"{zero}Z"}
    return Contents("NI TDMS", variables, about, file.close)


@contextmanager
def _parsing(path: Path, channel: str | None = None) -> Iterator[None]:
    try:
        yield
    except (MemoryError, BadInput):
        raise
    except Exception as error:  # the parser stumbles in as many ways as a file can be damaged
        what = f"is not a whole TDMS file: {error or type(error).__name__}"
        raise BadInput(what, file=path, channel=channel, hint="copy it again") from None


def _check_scales(said: Mapping[str, Any]) -> None:
    """nptdms counts to the number of scales that is claimed; each needs properties of its own."""
    if said.get("NI_Number_Of_Scales", 0) > len(said):
        raise ValueError(f"claims {said['NI_Number_Of_Scales']} scales")


def _absolute(value: object) -> np.datetime64 | None:
    known = isinstance(value, np.datetime64) and not np.isnat(value) and value > EPOCH
    return value if known else None  # type: ignore[return-value]


def _variable(path: Path, channel: Any, note: str, begun: float) -> Variable:
    said = channel.properties
    step, offset = said.get("wf_increment"), said.get("wf_start_offset", 0.0)
    rate = rate_of(step)
    start = None if rate is None else float(offset) + begun
    unit = spelled(str(said.get("unit_string") or said.get("NI_UnitDescription") or ""))

    def fetch(first: int, stop: int) -> NDArray[Any]:
        with _parsing(path, channel.name):
            return np.asarray(channel[first:stop])

    dtype = np.dtype(channel.dtype)
    check_claim(len(channel) * dtype.itemsize, path.stat().st_size, file=path, channel=channel.name)
    return Variable(Lazy((len(channel),), dtype, fetch), unit, rate, start, note)
