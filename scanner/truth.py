"""The true values in a simulated recording, ``/truth``, which no estimator may read.

They are not part of :class:`scanner.recording.Recording`, so that code that works from a recording cannot read them.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from scanner.errors import BadInput
from scanner.hdf5 import attributes, child, open_hdf5, undamaged

Truth = Mapping[str, Any]
"""Nested: name -> array, number, text, ``(one of these, attributes)``, or a mapping of the same kind."""


def write_truth(group: h5py.Group, truth: Truth) -> None:
    """Store a nested truth in an open group of an HDF5 file."""
    for name, value in truth.items():
        if isinstance(value, Mapping):
            write_truth(group.create_group(name), value)
        else:
            data, attrs = value if isinstance(value, tuple) else (value, {})
            group.create_dataset(name, data=data).attrs.update(attrs)


def read_truth(path: str | Path) -> dict[str, Any] | None:
    """Return the truth in the file of a recording, as given to :func:`write_truth`; None where there is none.

    Datasets with attributes come back as ``(array, attributes)``.

    Raises:
        BadInput: the file cannot be read, or its truth is not stored in it.
    """
    with open_hdf5(Path(path)) as file, undamaged(path):
        group = child(file, "truth", h5py.Group)
        return None if group is None else _read(group)


def _read(group: h5py.Group) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for name in group:
        item = child(group, name, h5py.HLObject)
        if isinstance(item, h5py.Group):
            out[name] = _read(item)
            continue
        try:
            value = item[()]
        except (OSError, TypeError) as error:
            raise BadInput(f"cannot be read: {error}", file=group.file.filename, channel=item.name) from None
        value = value.decode() if isinstance(value, bytes) else value.item() if isinstance(value, np.generic) else value
        attrs = attributes(item)
        out[name] = (value, attrs) if attrs else value
    return out
