"""Opening other people's HDF5: what stands in the file is read, and nothing that only points elsewhere."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
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


@contextmanager
def undamaged(path: object, channel: str | None = None) -> Iterator[None]:
    """For reading from a file that is open: what HDF5 cannot make sense of becomes BadInput."""
    try:
        yield
    except BadInput:
        raise
    except DAMAGE as error:
        raise BadInput(f"cannot be read: {error}", file=path, channel=channel, hint="copy the file again") from None


def open_hdf5(path: Path, growing: bool = False) -> h5py.File:
    """The file, for reading.

    Args:
        growing: another program may be writing it at the same time (HDF5's single writer, multiple readers).

    Raises:
        BadInput: it is not there, empty, no HDF5, or cut short.
    """
    if not path.is_file():
        what = "is a folder" if path.is_dir() else "no such file"
        raise BadInput(what, file=path, hint="name a recording (HDF5)")
    if path.stat().st_size == 0:
        raise BadInput("the file is empty", file=path, hint="copy it again")
    try:
        return h5py.File(path, "r", swmr=growing)
    except PermissionError:
        raise BadInput("may not be read", file=path, hint="check its permissions") from None
    except OSError as error:
        if not h5py.is_hdf5(path):
            hint = "name a recording, or make one with `lissajous convert`"
            raise BadInput("is not an HDF5 file", file=path, hint=hint) from None
        what = "the file is truncated" if "truncated" in str(error) else f"cannot be opened: {error}"
        raise BadInput(what, file=path, hint="copy it again") from None


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
