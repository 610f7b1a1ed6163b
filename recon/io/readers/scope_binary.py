"""Oscilloscopes' binary files through RigolWFM (extra ``scope``): Rigol, Tektronix, LeCroy, Keysight, Siglent, ..."""

from __future__ import annotations

import io
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np

from recon.io.readers.contents import Contents, Variable, rate_from_step
from recon.io.readers.reader import Reader
from scanner.errors import BadInput

PARSERS_WITH_UNITS = ("wfm1000z", "wfm2000", "wfm4000", "wfm6000", "agilent_bin", "dho1000")
"""Parsers of RigolWFM that read the unit from the file. The others report volts whatever the file states."""

UNIT_NAMES = {"v": "V", "volts": "V", "a": "A", "amps": "A", "w": "W", "watts": "W"}


def read_scope(path: Path) -> Contents:
    """Analog channels of an oscilloscope's binary file; time 0 is the trigger.

    The whole file is read at once; it is no larger than the oscilloscope's memory.

    Raises:
        BadInput: RigolWFM is not installed or does not know the file, or the file is damaged.
    """
    try:
        from RigolWFM.wfm import Wfm
    except ImportError:
        hint = "pip install 'lissajous[scope]'"
        raise BadInput("reading an oscilloscope's binary needs the package RigolWFM", file=path, hint=hint) from None
    if not path.is_file():
        raise BadInput("no such file", file=path, hint="name the instrument's file")
    try:
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()), np.errstate(all="ignore"):
            read = Wfm.from_file(str(path))
            variables = {
                str(channel.name).replace(" ", ""): _variable(channel, read.parser_name) for channel in read.channels
            }
    except MemoryError:
        raise
    except Exception as error:  # a damaged file can make the parsers raise anything
        reason = str(error).replace(f"{path.parent}/", "") or type(error).__name__
        what = f"is not a whole file of a known oscilloscope: {reason}"
        raise BadInput(what, file=path, hint="copy it again, or save it as CSV") from None
    if not variables:
        raise BadInput("holds no analog channel", file=path, hint="record or export it again")
    return Contents(f"oscilloscope binary ({read.parser_name})", variables, {"device": str(read.header_name)})


def _variable(channel: Any, parser: str) -> Variable:
    values, times, step = np.asarray(channel.volts), channel.times, float(channel.seconds_per_point)
    rate = rate_from_step(step)
    start = float(times[0]) if times is not None and len(times) and np.isfinite(times[0]) else None
    unit = UNIT_NAMES.get(str(getattr(channel.unit, "name", ""))) if parser in PARSERS_WITH_UNITS else None
    return Variable(values, unit, rate, start if rate is not None else None)


READER = Reader("scope", read_scope, suffixes=(".wfm", ".bin", ".trc", ".isf", ".wvf", ".hdr"))
