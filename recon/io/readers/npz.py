"""NumPy archives. Each array is unpacked into a temporary file, so that memory holds one block of it."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from errno import EINVAL
from functools import cache, partial
from math import prod
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np
from numpy.typing import NDArray

from recon.io.readers.contents import Contents, Variable, map_blocks
from recon.io.readers.reader import Reader
from scanner.channel import LazySamples
from scanner.errors import BadInput
from scanner.files import check_claim

BLOCK_BYTES = 1 << 23
"""Bytes unpacked at a time: large enough that the loop costs nothing, small against memory."""


def read_npz(path: Path) -> Contents:
    """Arrays of an .npz archive. Pickled objects are not loaded.

    Raises:
        BadInput: no such file, not an archive of arrays, or damaged.
    """
    variables = {}
    with _parsing(path), zipfile.ZipFile(path) as archive:
        for info in archive.infolist():
            if info.filename.endswith(".npy"):
                name = info.filename.removesuffix(".npy")
                with archive.open(info) as file:
                    shape, _, dtype = _header(cast(BinaryIO, file))
                claimed = prod(shape) * dtype.itemsize
                check_claim(claimed, min(info.compress_size, path.stat().st_size), file=path, channel=name)
                load = cache(partial(_load, path, info.filename))
                variables[name] = Variable(LazySamples(shape, dtype, partial(_rows, load)))
    return Contents("NumPy archive", variables)


@contextmanager
def _parsing(path: Path) -> Iterator[None]:
    if not path.is_file():
        raise BadInput("no such file", file=path, hint="name the instrument's file")
    try:
        yield
    except (BadInput, MemoryError):
        raise
    except Exception as error:  # a damaged file can make the parsers raise anything
        if isinstance(error, OSError) and error.errno not in (None, EINVAL):
            raise  # such as a full disk; EINVAL comes from a damaged directory with negative offsets
        what = f"is not a whole NumPy archive: {error or type(error).__name__}"
        raise BadInput(what, file=path, hint="copy or save it again") from None


def _rows(load: Callable[[], NDArray[Any]], first: int, stop: int) -> NDArray[Any]:
    return load()[first:stop]


def _header(file: BinaryIO) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    return read(file)


def _load(path: Path, member: str) -> NDArray[Any]:
    """An array of the archive, mapped from a temporary file."""
    with _parsing(path), zipfile.ZipFile(path) as archive, archive.open(member) as file:
        shape, columns_first, dtype = _header(cast(BinaryIO, file))
        flat = map_blocks(_values(cast(BinaryIO, file), dtype, prod(shape)), path)
    return flat.reshape(shape, order="F" if columns_first else "C")


def _values(file: BinaryIO, dtype: np.dtype[Any], count: int) -> Iterator[NDArray[Any]]:
    while count:
        data = file.read(dtype.itemsize * min(count, BLOCK_BYTES // dtype.itemsize + 1))
        if not data:
            raise EOFError("an array ends early")
        values = np.frombuffer(data[: len(data) - len(data) % dtype.itemsize], dtype)
        count -= len(values)
        yield values


READER = Reader("npz", read_npz, beginnings=(b"PK\x03\x04",), suffixes=(".npz",))
