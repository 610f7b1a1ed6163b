"""Point clouds in the files of the field: PCD (Point Cloud Library) and LAS."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.point_cloud import PointCloud
from scanner.errors import BadInput

FORMATS = {"pcd": "pypcd4", "las": "laspy"}
"""Format, and the library that writes it."""

COVARIANCES = ("cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz")
"""Fields of the covariance [m²]."""

LAS_SCALE_M = 1e-5
"""Step of LAS coordinates, which are 32-bit integers: 10 µm, with a reach of 21 km."""

LAS_INTENSITY_MAX = 65535
"""Largest intensity of a LAS file, which has 16-bit integers; the values themselves are the dimension ``value``."""


def require_format(name: str) -> None:
    """Check that the library for a format is installed.

    Raises:
        BadInput: it is not.
    """
    if find_spec(FORMATS[name]) is None:
        raise BadInput(f"writing .{name} needs {FORMATS[name]}", hint="pip install 'lissajous[points]'")


def write_points(path: Path, cloud: PointCloud, name: str) -> None:
    """Write a point cloud as ``pcd`` or ``las``.

    Raises:
        BadInput: a point is too far away for LAS.
    """
    {"pcd": _write_pcd, "las": _write_las}[name](path, cloud)


def _write_pcd(path: Path, cloud: PointCloud) -> None:
    from pypcd4 import Encoding
    from pypcd4 import PointCloud as Points

    single = np.float32
    columns: dict[str, NDArray[Any]] = {name: cloud.position[:, k].astype(single) for k, name in enumerate("xyz")}
    columns |= {"intensity": cloud.intensity.astype(single), "time": cloud.time}
    columns |= {name: cloud.covariance[:, k].astype(single) for k, name in enumerate(COVARIANCES)}
    types = [column.dtype.type for column in columns.values()]
    Points.from_points(list(columns.values()), tuple(columns), tuple(types)).save(path, encoding=Encoding.BINARY)


def _write_las(path: Path, cloud: PointCloud) -> None:
    import laspy

    farthest = float(np.abs(cloud.position).max(initial=0.0))
    if farthest > LAS_SCALE_M * np.iinfo(np.int32).max:
        what = f"a point lies {farthest:.4g} m away, more than LAS can hold in steps of {LAS_SCALE_M:g} m"
        raise BadInput(what, channel="range", hint="remove ranges without a return, or write --format pcd")
    header = laspy.LasHeader(point_format=6, version="1.4")  # 6 has a time for each point
    header.scales, header.offsets = np.full(3, LAS_SCALE_M), np.zeros(3)
    header.generating_software = "lissajous"
    names = ("value", *COVARIANCES)
    header.add_extra_dims([laspy.ExtraBytesParams(name, np.float32) for name in names])
    las = laspy.LasData(header)
    las.x, las.y, las.z = cloud.position.T
    las.gps_time = cloud.time
    las.intensity = _to_16_bits(cloud.intensity)
    for name, values in zip(names, (cloud.intensity, *cloud.covariance.T), strict=True):
        las[name] = values.astype(np.float32)
    las.write(path)


def _to_16_bits(values: NDArray[Any]) -> NDArray[np.uint16]:
    """Values stretched over the range of a LAS intensity; 0 where there is none."""
    finite = values[np.isfinite(values)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    scaled = (np.nan_to_num(values, nan=low) - low) / max(high - low, 1e-300)
    return np.round(scaled * LAS_INTENSITY_MAX).astype(np.uint16)
