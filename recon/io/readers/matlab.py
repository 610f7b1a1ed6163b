"""MATLAB files: version 4 to 7.2 through scipy, version 7.3 as HDF5."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import lru_cache, partial
from math import prod
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from recon.io.readers.contents import Contents, Variable
from recon.io.readers.hdf5 import read_hdf5, vector
from recon.io.readers.reader import Reader
from scanner.channel import LazySamples
from scanner.errors import BadInput
from scanner.files import check_claim
from scanner.hdf5 import MAX_GROUP_DEPTH


class ComplexValues(BadInput):
    """A variable that is complex, or holds a complex field, was read as real numbers."""


Load = Callable[[str], NDArray[Any]]

DTYPES = {"double": "f8", "single": "f4", "logical": "?", "char": "U1"} | {
    f"{'u' * (kind == 'u')}int{8 * size}": f"{kind}{size}" for kind in "iu" for size in (1, 2, 4, 8)
}
"""numpy's type for each MATLAB class; variables of other classes have type object."""


def read_matlab(path: Path) -> Contents:
    """Variables of a MATLAB file. An (n, 1) or (1, n) matrix, which is MATLAB's vector, becomes (n,). The fields of a
    structure have dotted names.

    Version 7.3 is read slice by slice, earlier versions one variable at a time; there none exceeds 2 GB.

    Raises:
        BadInput: no such file, no MATLAB file, or a damaged one.
    """
    if path.is_file() and h5py.is_hdf5(path):
        return read_hdf5(path)
    from scipy.io import whosmat

    table = _through_scipy(path, whosmat)
    load = lru_cache(maxsize=1)(partial(_load, path))  # channels are read one after the other
    variables: dict[str, Variable] = {}
    for name, shape, kind in table:
        if kind == "struct" and prod(shape) == 1:
            variables |= _fields(load, name, load(name))
        else:
            variables[name] = Variable(_lazy(path, load, name, shape, kind))
    return Contents("MATLAB 4 to 7.2", variables)


def _through_scipy(path: Path, read: Callable[..., Any], **options: Any) -> Any:
    if not path.is_file():
        raise BadInput("no such file", file=path, hint="name the instrument's file")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", np.exceptions.ComplexWarning)  # which would lose the imaginary part
            return read(path, **options)
    except MemoryError:
        raise
    except np.exceptions.ComplexWarning:
        raise ComplexValues("holds complex values", file=path) from None
    except Exception as error:  # a damaged file can make the parser raise anything
        what = f"is not a whole MATLAB file: {error or type(error).__name__}"
        raise BadInput(what, file=path, hint="copy or save it again") from None


def _lazy(path: Path, load: Load, name: str, shape: tuple[int, ...], kind: str) -> LazySamples:
    dtype = np.dtype(DTYPES.get(kind, "O"))
    if dtype.kind in "iuf":
        check_claim(dtype.itemsize * prod(shape), path.stat().st_size, file=path, channel=name)
    shape = vector(shape)

    def fetch(first: int, stop: int) -> NDArray[Any]:
        values = load(name)
        if values.dtype.kind == "c":  # the file's directory does not state it
            hint = "save real and imaginary part as two variables"
            raise BadInput("holds complex values", file=path, channel=name, hint=hint)
        return values.reshape(shape)[first:stop]

    return LazySamples(shape, dtype, fetch)


def _fields(load: Load, name: str, value: NDArray[Any], keys: tuple[str, ...] = ()) -> dict[str, Variable]:
    """Fields of a structure, and of structures in it, with dotted names.

    Args:
        load: returns the variable.
        name: of the variable.
        value: the structure, or a field of it.
        keys: the names of the fields that lead to ``value``.
    """
    if value.dtype.names and value.size == 1 and len(keys) < MAX_GROUP_DEPTH:
        inner = (_fields(load, name, np.asarray(value.reshape(-1)[0][key]), (*keys, key)) for key in value.dtype.names)
        return {field: variable for fields in inner for field, variable in fields.items()}
    shape = vector(value.shape)

    def fetch(first: int, stop: int) -> NDArray[Any]:
        content = load(name)
        for key in keys:
            content = np.asarray(content.reshape(-1)[0][key])
        return content.reshape(shape)[first:stop]

    return {".".join((name, *keys)): Variable(LazySamples(shape, value.dtype, fetch))}


def _load(path: Path, name: str) -> NDArray[Any]:
    from scipy.io import loadmat

    read = partial(_through_scipy, path, loadmat, variable_names=[name])
    try:
        content = read(mat_dtype=True)
    except ComplexValues:
        content = read()  # complex fields remain complex; whole numbers have the type in which the file stores them
    if name not in content:
        raise BadInput("cannot be read", file=path, channel=name, hint="copy or save the file again")
    return content[name]


READER = Reader("matlab", read_matlab, beginnings=(b"MATLAB ",), suffixes=(".mat",))
