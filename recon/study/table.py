"""The table of a study, a row for each cell and axis: as CSV, as Parquet, as columns, and summarised by estimator."""

from __future__ import annotations

import csv
import importlib.util
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.device import AXES
from scanner.errors import BadInput

Row = dict[str, Any]
Columns = Mapping[str, NDArray[Any]]

CELL_COLUMNS = ("phantom", "design", "drift", "snr_db", "estimator", "pixels", "p", "seed")
AXIS_COLUMNS = (
    "phase_rmse_deg", "phase_bias_deg", "phase_sd_deg", "bound_deg", "within_bound", "amplitude_rmse",
    "seen_deg", "seen_sd_deg",
    "blur_phase_px", "blur_amplitude_px", "blur_sampling_px", "blur_optics_px", "blur_total_px",
)  # fmt: skip
SCAN_COLUMNS = ("picture_error", "fill", "seconds")
COLUMN_NAMES = (*CELL_COLUMNS, "axis", *AXIS_COLUMNS, *SCAN_COLUMNS, "failed")
TEXT_COLUMNS = ("phantom", "design", "estimator", "axis", "failed")


def table_rows(records: Iterable[Mapping[str, Any]]) -> list[Row]:
    """Return a row for each record and axis with all of ``COLUMN_NAMES``; None where there is no result."""
    return [
        {name: record["cell"][name] for name in CELL_COLUMNS}
        | {"axis": axis}
        | {name: record.get(axis, {}).get(name) for name in AXIS_COLUMNS}
        | {name: record.get(name) for name in (*SCAN_COLUMNS, "failed")}
        for record in records
        for axis in AXES
    ]


def table_columns(table: Sequence[Row]) -> Columns:
    """Return the rows as arrays of shape (rows,): text as str, numbers as float64 with nan for None."""
    return {
        name: np.array([row[name] or "" for row in table])
        if name in TEXT_COLUMNS
        else np.array([row[name] for row in table], np.float64)
        for name in COLUMN_NAMES
    }


def write_csv(path: Path, table: Sequence[Row]) -> None:
    """Write the rows with a header; None becomes an empty field."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMN_NAMES)
        writer.writeheader()
        writer.writerows(table)


def require_parquet() -> None:
    """Raise BadInput, with the command that installs it, if pyarrow is missing."""
    if importlib.util.find_spec("pyarrow") is None:
        raise BadInput("--parquet needs pyarrow", hint="pip install 'lissajous[parquet]'")


def write_parquet(path: Path, table: Sequence[Row]) -> None:
    """Write the rows as Parquet, with column types that do not depend on the values."""
    import pyarrow
    import pyarrow.parquet

    kinds = {name: pyarrow.string() if name in TEXT_COLUMNS else pyarrow.float64() for name in COLUMN_NAMES}
    kinds |= {name: pyarrow.int64() for name in ("pixels", "seed")}
    pyarrow.parquet.write_table(pyarrow.Table.from_pylist(list(table), pyarrow.schema(kinds.items())), path)


def estimator_statistics(table: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Return phase error, fraction of the scan within the bound, picture error and failures by estimator."""
    if not table:
        return {}
    data = table_columns(table)
    out = {}
    for name in dict.fromkeys(data["estimator"]):
        of_estimator = data["estimator"] == name
        succeeded = of_estimator & (data["failed"] == "")
        error = data["phase_rmse_deg"][succeeded]
        out[str(name)] = {
            "phase_rmse_deg_median": float(np.median(error)) if error.size else np.nan,
            "phase_rmse_deg_p95": float(np.percentile(error, 95)) if error.size else np.nan,
            "within_bound": float(np.mean(data["within_bound"][succeeded])) if error.size else np.nan,
            "picture_error_median": float(np.nanmedian(data["picture_error"][succeeded])) if error.size else np.nan,
            "seconds_median": float(np.median(data["seconds"][succeeded])) if error.size else np.nan,
            "failed": float(np.mean(data["failed"][of_estimator] != "")),
        }
    return out
