"""Instruments' files: one small reader a format, all of which give :class:`recon.readers.contents.Contents`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from recon.readers.contents import Contents
from recon.readers.hdf5 import read_hdf5
from recon.readers.labview import MAGIC, read_lvm
from recon.readers.matlab import read_matlab
from recon.readers.npz import read_npz
from recon.readers.scope_binary import read_scope
from recon.readers.scope_csv import read_csv
from recon.readers.tdms import read_tdms
from recon.readers.wav import read_wav
from scanner.errors import BadInput

READERS: dict[str, Callable[[Path], Contents]] = {
    "matlab": read_matlab,
    "hdf5": read_hdf5,
    "tdms": read_tdms,
    "lvm": read_lvm,
    "csv": read_csv,
    "scope": read_scope,
    "npz": read_npz,
    "wav": read_wav,
}

# What a file begins with tells more than its name does.
_BEGINNINGS = {
    b"MATLAB ": "matlab", b"\x89HDF\r\n\x1a\n": "hdf5", b"TDSm": "tdms", MAGIC.encode(): "lvm", b"RIFF": "wav",
    b"RIFX": "wav", b"RF64": "wav", b"PK\x03\x04": "npz",
}  # fmt: skip
_ENDINGS = {
    ".mat": "matlab", ".tdms": "tdms", ".lvm": "lvm", ".csv": "csv", ".tsv": "csv", ".txt": "csv", ".npz": "npz",
    ".wav": "wav", ".wfm": "scope", ".bin": "scope", ".trc": "scope", ".isf": "scope", ".wvf": "scope", ".hdr": "scope",
}  # fmt: skip


def format_of(path: Path) -> str:
    """The format of a file, by how it begins, else by its name.

    Raises:
        BadInput: it cannot be read, or neither tells.
    """
    try:
        with path.open("rb") as file:
            begin = file.read(32)
    except OSError as error:
        raise BadInput(f"cannot be read: {error.strerror}", file=path, hint="name the instrument's file") from None
    if not begin:
        raise BadInput("the file is empty", file=path, hint="copy it again")
    told = next((name for magic, name in _BEGINNINGS.items() if begin.startswith(magic)), None)
    told = told or _ENDINGS.get(path.suffix.lower())
    if told is None:
        hint = f"name it in the mapping or by --format: {', '.join(READERS)}"
        raise BadInput("is of no format that is known by its beginning or its name", file=path, hint=hint)
    return told


def read(path: Path, name: str | None = None) -> Contents:
    """What a file holds, by the reader ``name``, or by :func:`format_of` where it is None.

    Raises:
        BadInput: an unknown format, or whatever the reader refuses.
    """
    name = name or format_of(path)
    if name not in READERS:
        known = ", ".join(READERS)
        raise BadInput(f"format {name!r} is unknown", file=path, channel="format", hint=f"known formats: {known}")
    contents = READERS[name](path)
    if not contents.variables:
        contents.close()
        raise BadInput(f"is read as {contents.kind}, with nothing in it", file=path, hint="record or export it again")
    return contents
