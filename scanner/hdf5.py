"""Opening other people's HDF5: what stands in the file is read, and nothing that only points elsewhere."""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from math import prod
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from scanner.errors import BadInput
from scanner.files import check_claim

DAMAGE = (OSError, RuntimeError, KeyError, ValueError, TypeError, OverflowError)
"""How h5py says that HDF5 cannot make sense of a file."""


MOST_VALUES = 1 << 16
"""Values that an attribute holds where HDF5 stores it with its object, a byte each."""


DEEPEST = 8
"""Groups within groups that are looked into."""

CPU_SECONDS, SECONDS = 5, 60
"""What HDF5 may take, of a processor and in all, to tell what a file holds: milliseconds where it is not damaged."""


@contextmanager
def undamaged(path: object, channel: str | None = None) -> Iterator[None]:
    """For reading from a file that is open: what HDF5 cannot make sense of becomes BadInput."""
    try:
        yield
    except BadInput:
        raise
    except DAMAGE as error:
        raise BadInput(f"cannot be read: {error}", file=path, channel=channel, hint="copy the file again") from None


def is_hdf5(path: Path) -> bool:
    """Whether there is a file that begins as HDF5 does, and may be read."""
    try:
        return path.is_file() and h5py.is_hdf5(path)
    except OSError:
        return False


def check_ends(path: Path) -> None:
    """Refuse a file on which HDF5 runs for ever, as it does on some that are damaged, or comes to grief.

    Nothing stops the library once it does, so a fork of this process looks at all groups and attributes first, and is
    ended by a timer. What else is wrong with the file is left to whoever opens it. Opening does not do this by itself:
    a program with threads, or on a system without ``fork``, may not want it.

    Raises:
        BadInput: the fork did not come back.
    """
    if not hasattr(os, "fork") or not is_hdf5(path):
        return
    looking = os.fork()
    if not looking:
        with suppress(BaseException):
            for which, number, limit in (
                (signal.ITIMER_PROF, signal.SIGPROF, CPU_SECONDS),
                (signal.ITIMER_REAL, signal.SIGALRM, SECONDS),
            ):
                signal.signal(number, signal.SIG_DFL)
                signal.setitimer(which, limit)
            with h5py.File(path, "r") as file:
                _look(file)
        os._exit(0)
    _, status = os.waitpid(looking, 0)
    if os.WIFSIGNALED(status):
        ended = "runs without end" if os.WTERMSIG(status) in (signal.SIGPROF, signal.SIGALRM) else "fails"
        raise BadInput(f"HDF5 {ended} on it: the file is damaged", file=path, hint="copy it again")


def _look(group: h5py.Group, depth: int = DEEPEST) -> None:
    attributes(group)
    for name in group:
        with suppress(*DAMAGE):
            item = child(group, name, h5py.HLObject)
            attributes(item)
            if isinstance(item, h5py.Group) and depth:
                _look(item, depth - 1)


def open_hdf5(path: Path, growing: bool = False) -> h5py.File:
    """The file, for reading.

    Args:
        growing: another program may be writing it at the same time (HDF5's single writer, multiple readers).

    Raises:
        BadInput: it is not there, empty, no HDF5, or cut short.
    """
    try:
        if not path.is_file():
            what = "is a folder" if path.is_dir() else "no such file"
            raise BadInput(what, file=path, hint="name a recording (HDF5)")
        if path.stat().st_size == 0:
            raise BadInput("the file is empty", file=path, hint="copy it again")
        return h5py.File(path, "r", swmr=growing)
    except PermissionError:
        raise BadInput("may not be read", file=path, hint="check its permissions") from None
    except OSError as error:
        if not is_hdf5(path):
            hint = "name a recording, or make one with `lissajous convert`"
            raise BadInput("is not an HDF5 file", file=path, hint=hint) from None
        what = "the file is truncated" if "truncated" in str(error) else f"cannot be opened: {error}"
        raise BadInput(what, file=path, hint="copy it again") from None


@contextmanager
def new_hdf5(path: Path) -> Iterator[h5py.File]:
    """A file to write into, whole when the block ends well.

    HDF5 2.0 crashes where it finds out while closing that the disk is full. So it keeps no samples back, and writes
    everything else before it is asked to close.

    Raises:
        OSError: the disk is full, or may not be written to.
    """
    access = h5py.h5p.create(h5py.h5p.FILE_ACCESS)
    access.set_fclose_degree(h5py.h5f.CLOSE_STRONG)
    access.set_sieve_buf_size(0)
    create = h5py.h5p.create(h5py.h5p.FILE_CREATE)
    try:
        file = h5py.File(h5py.h5f.create(os.fsencode(path), h5py.h5f.ACC_TRUNC, create, access))
        try:
            yield file
            file.flush()
        finally:
            file.close()
    except (OSError, RuntimeError) as error:
        told = re.search(r"(?:write failed|extend file|create file).*?errno = (\d+)", str(error), re.DOTALL)
        if told is None:
            raise
        raise OSError(int(told[1]), os.strerror(int(told[1])), str(path)) from None


def child(group: h5py.Group, name: str, kind: type) -> Any:
    """The group or dataset ``name`` stored in ``group`` itself, None where there is none.

    Raises:
        BadInput: it is a link (whatever a link points to, another program put it there: the recording must be whole
            without it), its samples are kept in another file, it claims more of them than it stores, or it is not of
            the ``kind`` h5py.Group or h5py.Dataset.
    """
    where = f"{group.name.rstrip('/')}/{name}"
    path = group.file.filename
    with undamaged(path, where):
        link = group.get(name, getlink=True)
    if link is None:
        return None
    if not isinstance(link, h5py.HardLink):
        raise BadInput("is a link", file=path, channel=where, hint="store the data itself in the file")
    with undamaged(path, where):
        item = group[name]
    if not isinstance(item, kind):
        what = f"is a {type(item).__name__.lower()}, not a {kind.__name__.lower()}"
        raise BadInput(what, file=path, channel=where, hint="see the form of a recording")
    if isinstance(item, h5py.Dataset):
        with undamaged(path, where):
            _check_samples(item, path, where)
    return item


def _check_samples(item: h5py.Dataset, path: str, where: str) -> None:
    if item.is_virtual or item.external:
        what = "keeps its samples outside this file"
        raise BadInput(what, file=path, channel=where, hint="store the data itself in the file")
    stored = min(item.id.get_storage_size(), Path(path).stat().st_size)
    check_claim(prod(item.shape or ()) * item.dtype.itemsize, stored, file=path, channel=where)


def attributes(item: h5py.HLObject) -> dict[str, Any]:
    """Attributes as Python values: text as str, arrays of one element as that element; BadInput where damaged."""
    with undamaged(item.file.filename, item.name):
        for key in item.attrs:
            shape = item.attrs.get_id(key).shape or ()
            if prod(shape) > MOST_VALUES:  # h5py would read them one by one
                what = f"attribute {key} claims {prod(shape)} values"
                raise BadInput(what, file=item.file.filename, channel=item.name, hint="copy the file again")
        return {key: _plain(value) for key, value in item.attrs.items()}


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.reshape(-1)[0]
    if isinstance(value, np.generic):
        value = value.item()
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else value
