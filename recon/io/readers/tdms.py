"""NI TDMS through nptdms (extra ``tdms``), read slice by slice."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.io.readers.contents import Contents, Variable, normalise_unit, rate_from_step, unique_names
from recon.io.readers.reader import Reader
from scanner.channel import LazySamples
from scanner.errors import BadInput
from scanner.files import check_claim

LABVIEW_EPOCH = np.datetime64("1904-01-01T00:00:00")
"""LabVIEW's zero of time. A waveform without an absolute start has this value."""

SECOND = np.timedelta64(1, "s")


def read_tdms(path: Path) -> Contents:
    """Channels of a TDMS file, named ``group/channel`` and scaled as stated; time 0 is the earliest start of a channel.

    Raises:
        BadInput: nptdms is not installed, or the file is damaged.
    """
    try:
        from nptdms import TdmsFile
        from nptdms.log import log_manager
    except ImportError:
        hint = "pip install 'lissajous[tdms]'"
        raise BadInput("reading TDMS needs the package nptdms", file=path, hint=hint) from None
    log_manager.set_level(logging.ERROR)  # its warnings are in the notes
    with _parsing(path):
        file = TdmsFile.open(path)
        note = "the file's last part is incomplete" if file.file_status.incomplete_final_segment else ""
        channels = [channel for group in file.groups() for channel in group.channels()]
        for item in (file, *file.groups(), *channels):
            _check_scales(item.properties)
        names = unique_names(f"{channel.group_name}/{channel.name}" for channel in channels)
        starts = [_absolute(channel.properties.get("wf_start_time")) for channel in channels]
        zero = min((time for time in starts if time is not None), default=None)
        variables = {
            name: _variable(path, channel, note, 0.0 if time is None else float((time - zero) / SECOND))
            for name, channel, time in zip(names, channels, starts, strict=True)
        }
    about = {} if zero is None else {"acquired": f"{zero}Z"}
    return Contents("NI TDMS", variables, about, file.close)


@contextmanager
def _parsing(path: Path, channel: str | None = None) -> Iterator[None]:
    try:
        yield
    except (MemoryError, BadInput):
        raise
    except Exception as error:  # a damaged file can make the parser raise anything
        what = f"is not a whole TDMS file: {error or type(error).__name__}"
        raise BadInput(what, file=path, channel=channel, hint="copy it again") from None


def _check_scales(properties: Mapping[str, Any]) -> None:
    """Refuse a number of scales without properties for each: nptdms would loop over all of them."""
    if properties.get("NI_Number_Of_Scales", 0) > len(properties):
        raise ValueError(f"claims {properties['NI_Number_Of_Scales']} scales")


def _absolute(value: object) -> np.datetime64 | None:
    known = isinstance(value, np.datetime64) and not np.isnat(value) and value > LABVIEW_EPOCH
    return value if known else None  # type: ignore[return-value]


def _variable(path: Path, channel: Any, note: str, begin: float) -> Variable:
    properties = channel.properties
    step, offset = properties.get("wf_increment"), properties.get("wf_start_offset", 0.0)
    rate = rate_from_step(step)
    start = None if rate is None else float(offset) + begin
    unit = normalise_unit(str(properties.get("unit_string") or properties.get("NI_UnitDescription") or ""))

    def fetch(first: int, stop: int) -> NDArray[Any]:
        with _parsing(path, channel.name):
            return np.asarray(channel[first:stop])

    dtype = np.dtype(channel.dtype)
    check_claim(len(channel) * dtype.itemsize, path.stat().st_size, file=path, channel=channel.name)
    return Variable(LazySamples((len(channel),), dtype, fetch), unit, rate, start, note)


READER = Reader("tdms", read_tdms, beginnings=(b"TDSm",), suffixes=(".tdms",))
