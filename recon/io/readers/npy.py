"""One NumPy array in a file of its own (.npy), memory-mapped."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from recon.io.readers.contents import Contents, Variable
from recon.io.readers.reader import Reader
from scanner.errors import BadInput


def read_npy(path: Path) -> Contents:
    """The array by the name of the file; the columns of a table, or the fields of a structured array, each by itself.

    Raises:
        BadInput: no such file, not an array, an array of Python objects, or damaged.
    """
    if not path.is_file():
        raise BadInput("no such file", file=path, hint="name the instrument's file")
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except MemoryError:
        raise
    except Exception as error:  # a damaged file can make the parser raise anything
        what = f"is not a whole NumPy array: {error or type(error).__name__}"
        raise BadInput(what, file=path, hint="save it again, by numpy.save") from None
    if array.dtype.names:
        columns = {name: array[name] for name in array.dtype.names}
    elif array.ndim == 2 and array.shape[0] >= array.shape[1] > 1:
        columns = {f"column {at + 1}": array[:, at] for at in range(array.shape[1])}
    else:
        columns = {path.stem: array}
    return Contents("NumPy array", {name: Variable(values) for name, values in columns.items()})


READER = Reader("npy", read_npy, beginnings=(b"\x93NUMPY",), suffixes=(".npy",))
