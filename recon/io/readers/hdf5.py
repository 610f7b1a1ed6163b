"""HDF5 files that are not recordings, and MATLAB 7.3 files; read slice by slice."""

from __future__ import annotations

from collections.abc import Iterator
from math import prod
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from recon.io.readers.contents import Contents, Variable, normalise_unit
from recon.io.readers.reader import Reader
from scanner.channel import LazySamples
from scanner.hdf5 import MAX_GROUP_DEPTH, attributes, child, open_hdf5, undamaged

UNIT_ATTRIBUTES = ("units", "unit")
"""Attributes of a dataset that state its unit, as netCDF, NeXus and h5py's users write them."""

RATE_ATTRIBUTES = ("sample_rate", "sampling_rate")
"""Attributes that state a sample rate in Hz."""

SCALING_ATTRIBUTES = ("scale_factor", "add_offset", "gain", "offset")
"""Attributes that scale the stored values to those in the stated unit."""


def read_hdf5(path: Path) -> Contents:
    """Datasets of an HDF5 file. Those in groups have dotted names; MATLAB's have the dimensions that MATLAB shows.

    Raises:
        BadInput: no such file, not HDF5, damaged, or with data in other files.
    """
    file = open_hdf5(path)
    try:
        with undamaged(path):
            datasets = dict(_datasets(file))
            matlab = {name for name, dataset in datasets.items() if "MATLAB_class" in dataset.attrs}
            variables = {
                name: Variable(_samples(path, dataset, name in matlab), **_statements(dataset))
                for name, dataset in datasets.items()
            }
    except BaseException:
        file.close()
        raise
    return Contents("MATLAB 7.3" if matlab else "HDF5", variables, close=file.close)


def _statements(dataset: h5py.Dataset) -> dict[str, Any]:
    """What the attributes of a dataset state: unit, sample rate [Hz] and start [s].

    Attributes that scale the stored values are named in a note, and the unit, which is that of the scaled values, is
    then left open.
    """
    stated = attributes(dataset, (*UNIT_ATTRIBUTES, *RATE_ATTRIBUTES, *SCALING_ATTRIBUTES, "start"))
    texts = [stated[key] for key in UNIT_ATTRIBUTES if isinstance(stated.get(key), str)]
    unit = normalise_unit(texts[0]) if texts else None
    scaling = [f"{key} = {stated[key]}" for key in SCALING_ATTRIBUTES if key in stated]
    rate = next((_number(stated[key]) for key in RATE_ATTRIBUTES if key in stated), None)
    found: dict[str, Any] = {"sample_rate": rate if rate and rate > 0.0 else None}
    if found["sample_rate"] is not None and "start" in stated:
        found["start"] = _number(stated["start"])
    if not scaling:
        return found | {"unit": unit}
    return found | {"note": f"stored with {', '.join(scaling)}{f', unit {unit}' if unit else ''}"}


def _number(value: object) -> float | None:
    """A finite number from an attribute, which may be an array of one; None for anything else."""
    array = np.asarray(value)
    if array.size != 1 or array.dtype.kind not in "iuf" or not np.isfinite(array).all():
        return None
    return float(array.reshape(-1)[0])


def vector(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Shape (n,) for a matrix of one row or column, which is how MATLAB stores a vector; other shapes unchanged."""
    return (prod(shape),) if len(shape) == 2 and 1 in shape else shape


def _datasets(group: h5py.Group, depth: int = MAX_GROUP_DEPTH) -> Iterator[tuple[str, h5py.Dataset]]:
    for name in group:
        if name.startswith("#"):  # MATLAB's internal tables
            continue
        item = child(group, name, h5py.HLObject)
        if isinstance(item, h5py.Dataset):
            yield name, item
        elif isinstance(item, h5py.Group) and depth:
            yield from ((f"{name}.{inner}", dataset) for inner, dataset in _datasets(item, depth - 1))


def _samples(path: Path, dataset: h5py.Dataset, matlab: bool) -> LazySamples:
    """A dataset; MATLAB files hold their dimensions in reverse order."""
    stored: tuple[int, ...] = dataset.shape or ()
    shape = vector(stored[::-1] if matlab else stored)
    text = matlab and attributes(dataset).get("MATLAB_class") == "char"

    def fetch(first: int, stop: int) -> NDArray[Any]:
        with undamaged(path, dataset.name):
            if len(shape) == 1 and len(stored) == 2:
                return dataset[first:stop, 0] if stored[1] == 1 else dataset[0, first:stop]
            return dataset[..., first:stop].T if matlab else dataset[first:stop]

    return LazySamples(shape, np.dtype("U1") if text else dataset.dtype, fetch)


READER = Reader("hdf5", read_hdf5, beginnings=(b"\x89HDF\r\n\x1a\n",))
