"""Reading HDF5 files from unknown sources: checks against damage, links and external storage; safe writing."""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from math import prod
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from scanner.errors import BadInput
from scanner.files import check_claim

DAMAGE = (OSError, RuntimeError, KeyError, ValueError, TypeError, OverflowError)
"""Exceptions by which h5py reports a damaged file."""


MAX_ATTRIBUTE_VALUES = 1 << 16
"""Largest accepted number of values in an attribute: HDF5 stores up to 64 kB with its object. h5py reads the
values of a larger one separately, which does not end where a damaged file states a huge number."""


MAX_GROUP_DEPTH = 8
"""Levels of groups that are checked; a recording has three, and a damaged file may hold a cycle."""

CHECK_CPU_TIME_S, CHECK_WALL_TIME_S = 5, 60
"""Time that HDF5 may take to list the content of a file, of the processor and in all. An undamaged file takes
milliseconds; the longer wall time allows for a busy computer or a slow network drive."""


@contextmanager
def undamaged(path: object, channel: str | None = None) -> Iterator[None]:
    """Turn the errors of h5py on a damaged file into BadInput within the block."""
    try:
        yield
    except BadInput:
        raise
    except DAMAGE as error:
        raise BadInput(f"cannot be read: {error}", file=path, channel=channel, hint="copy the file again") from None


def is_hdf5(path: Path) -> bool:
    """Whether the path is a readable file with the signature of HDF5."""
    try:
        return path.is_file() and h5py.is_hdf5(path)
    except OSError:
        return False


def check_ends(path: Path) -> None:
    """Check that HDF5 does not hang or crash on a file, as it does on some damaged ones.

    The library cannot be interrupted once it hangs. Therefore a fork of this process reads all groups and attributes
    first, and a timer ends it. Other faults of the file are reported by the function that opens it. Opening does not
    call this check, because a program with threads, or on a system without ``fork``, cannot use it.

    Raises:
        BadInput: the fork was ended by the timer or crashed.
    """
    if not hasattr(os, "fork") or not is_hdf5(path):
        return
    child_pid = os.fork()
    if not child_pid:
        with suppress(BaseException):
            for which, number, limit in (
                (signal.ITIMER_PROF, signal.SIGPROF, CHECK_CPU_TIME_S),
                (signal.ITIMER_REAL, signal.SIGALRM, CHECK_WALL_TIME_S),
            ):
                signal.signal(number, signal.SIG_DFL)
                signal.setitimer(which, limit)
            with h5py.File(path, "r") as file:
                _read_all(file)
        os._exit(0)
    _, status = os.waitpid(child_pid, 0)
    if os.WIFSIGNALED(status):
        ended = "runs without end" if os.WTERMSIG(status) in (signal.SIGPROF, signal.SIGALRM) else "fails"
        raise BadInput(f"HDF5 {ended} on it: the file is damaged", file=path, hint="copy it again")


def _read_all(group: h5py.Group, depth: int = MAX_GROUP_DEPTH) -> None:
    attributes(group)
    for name in group:
        with suppress(*DAMAGE):
            item = child(group, name, h5py.HLObject)
            attributes(item)
            if isinstance(item, h5py.Group) and depth:
                _read_all(item, depth - 1)


def open_hdf5(path: Path, growing: bool = False) -> h5py.File:
    """Open a file for reading.

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
    """Yield a new file to write into; it is complete when the block ends without error.

    HDF5 2.0 crashes if it detects a full disk while it closes a file. Therefore samples are not buffered, and
    everything else is flushed before the file is closed.

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
        error_number = re.search(r"(?:write failed|extend file|create file).*?errno = (\d+)", str(error), re.DOTALL)
        if error_number is None:
            raise
        raise OSError(int(error_number[1]), os.strerror(int(error_number[1])), str(path)) from None


def child(group: h5py.Group, name: str, kind: type) -> Any:
    """Return the group or dataset ``name`` that is stored in ``group`` itself; None where there is none.

    Args:
        group: of an open file.
        name: of the item.
        kind: h5py.Group, h5py.Dataset, or h5py.HLObject for either.

    Raises:
        BadInput: it is a link (a recording must not depend on what a link points to), its samples are stored in another
            file, it states more of them than it stores, or it is of another kind.
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
        raise BadInput(what, file=path, channel=where, hint="see docs/reference/recording.md")
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


def attributes(item: h5py.HLObject, names: Collection[str] | None = None) -> dict[str, Any]:
    """Return attributes as Python values: text as str, arrays of one element as that element.

    Args:
        item: group or dataset.
        names: of the attributes that are wanted, where they exist; all where None.

    Raises:
        BadInput: they are damaged, or state more than ``MAX_ATTRIBUTE_VALUES`` values.
    """
    with undamaged(item.file.filename, item.name):
        wanted = [key for key in item.attrs if names is None or key in names]
        for key in wanted:
            shape = item.attrs.get_id(key).shape or ()
            if prod(shape) > MAX_ATTRIBUTE_VALUES:
                what = f"attribute {key} claims {prod(shape)} values"
                raise BadInput(what, file=item.file.filename, channel=item.name, hint="copy the file again")
        return {key: _plain(item.attrs[key]) for key in wanted}


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.reshape(-1)[0]
    if isinstance(value, np.generic):
        value = value.item()
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else value
