"""Oscilloscopes' binary files through RigolWFM (extra ``scope``): Rigol, Tektronix, LeCroy, Keysight, Siglent, ..."""

from __future__ import annotations

import io
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np

from recon.readers.contents import Contents, Variable, rate_of
from scanner.errors import BadInput

# RigolWFM reads the unit from these files; for others it says volts whatever the file says.
STATE_UNITS = ("wfm1000z", "wfm2000", "wfm4000", "wfm6000", "agilent_bin", "dho1000")
UNITS = {"v": "V", "volts": "V", "a": "A", "amps": "A", "w": "W", "watts": "W"}


def read_scope(path: Path) -> Contents:
    """Analog channels of an oscilloscope's own file, on the trigger's clock.

    The whole file is read at once: an oscilloscope's memory bounds it.

    Raises:
        BadInput: RigolWFM is not installed, no file of an oscilloscope it knows, or a damaged one.
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
            variables = {str(each.name).replace(" ", ""): _variable(each, read.parser_name) for each in read.channels}
    except MemoryError:
        raise
    except Exception as error:  # the parsers stumble in as many ways as a file can be damaged
        said = str(error).replace(f"{path.parent}/", "") or type(error).__name__
        what = f"is not a whole file of a known oscilloscope: {said}"
        raise BadInput(what, file=path, hint="copy it again, or save it as CSV") from None
    if not variables:
        raise BadInput("holds no analog channel", file=path, hint="record or export it again")
    return Contents(f"oscilloscope binary ({read.parser_name})", variables, {"device": str(read.header_name)})


def _variable(channel: Any, parser: str) -> Variable:
    values, times, step = np.asarray(channel.volts), channel.times, float(channel.seconds_per_point)
    rate = rate_of(step)
    start = float(times[0]) if times is not None and len(times) and np.isfinite(times[0]) else None
    unit = UNITS.get(str(getattr(channel.unit, "name", ""))) if parser in STATE_UNITS else None
    return Variable(values, unit, rate, start if rate is not None else None)
