"""The table of a study: a row for each cell and axis; as CSV, as Parquet, as columns, and summed up by estimator."""

from __future__ import annotations

import csv
import importlib.util
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.pipeline import AXES
from scanner.errors import BadInput

Row = dict[str, Any]
Columns = Mapping[str, NDArray[Any]]

CELL = ("phantom", "design", "drift", "snr_db", "estimator", "pixels", "p", "seed")
MEASURED = (
    "phase_rmse_deg", "phase_bias_deg", "phase_sd_deg", "bound_deg", "within_bound", "amplitude_rmse",
    "seen_deg", "seen_sd_deg",
    "blur_phase_px", "blur_amplitude_px", "blur_sampling_px", "blur_optics_px", "blur_total_px",
)  # fmt: skip
SHARED = ("picture_error", "fill", "seconds")
NAMES = (*CELL, "axis", *MEASURED, *SHARED, "failed")
TEXTS = ("phantom", "design", "estimator", "axis", "failed")


def rows(records: Iterable[Mapping[str, Any]]) -> list[Row]:
    """A row for each record and axis with all of ``NAMES``; what was not measured is None."""
    return [
        {name: record["cell"][name] for name in CELL}
        | {"axis": axis}
        | {name: record.get(axis, {}).get(name) for name in MEASURED}
        | {name: record.get(name) for name in (*SHARED, "failed")}
        for record in records
        for axis in AXES
    ]


def columns(table: Sequence[Row]) -> Columns:
    """The rows as arrays of shape (rows,): text as str, numbers as float64 with nan for None."""
    return {
        name: np.array([row[name] or "" for row in table])
        if name in TEXTS
        else np.array([row[name] for row in table], np.float64)
        for name in NAMES
    }


def write_csv(path: Path, table: Sequence[Row]) -> None:
    """The rows with a head; None is an empty field."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, NAMES)
        writer.writeheader()
        writer.writerows(table)


def require_parquet() -> None:
    """Raises BadInput, with what to install, where pyarrow is missing."""
    if importlib.util.find_spec("pyarrow") is None:
        raise BadInput("--parquet needs pyarrow", hint="pip install 'lissajous[parquet]'")


def write_parquet(path: Path, table: Sequence[Row]) -> None:
    """The rows as Parquet, with types that do not hang on what they hold."""
    import pyarrow
    import pyarrow.parquet

    kinds = {name: pyarrow.string() if name in TEXTS else pyarrow.float64() for name in NAMES}
    kinds |= {name: pyarrow.int64() for name in ("pixels", "seed")}
    pyarrow.parquet.write_table(pyarrow.Table.from_pylist(list(table), pyarrow.schema(kinds.items())), path)


def statistics(table: Sequence[Row]) -> dict[str, dict[str, float]]:
    """By estimator: phase error over all rows, fraction of the scan within the bound, picture's error, failures."""
    if not table:
        return {}
    data = columns(table)
    out = {}
    for name in dict.fromkeys(data["estimator"]):
        own = data["estimator"] == name
        worked = own & (data["failed"] == "")
        error = data["phase_rmse_deg"][worked]
        out[str(name)] = {
            "phase_rmse_deg_median": float(np.median(error)) if error.size else np.nan,
            "phase_rmse_deg_p95": float(np.percentile(error, 95)) if error.size else np.nan,
            "within_bound": float(np.mean(data["within_bound"][worked])) if error.size else np.nan,
            "picture_error_median": float(np.nanmedian(data["picture_error"][worked])) if error.size else np.nan,
            "seconds_median": float(np.median(data["seconds"][worked])) if error.size else np.nan,
            "failed": float(np.mean(data["failed"][own] != "")),
        }
    return out
