"""``lissajous diagnose --each FOLDER``: every recording by itself, and one table of all devices."""

from __future__ import annotations

import csv
import json
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from recon.cli.diagnose import diagnose_files

COLUMNS = (
    "recording", "device", "verdict", "axis", "stage", "effect", "probability", "share",
    "parameter", "value", "ci95_low", "ci95_high", "unit", "failed",
)  # fmt: skip
"""Columns of table.csv: a line for each parameter of each finding, and one for a recording without findings."""


def diagnose_each(
    places: Sequence[Path],
    output: Path,
    device: str | Path | None = None,
    mapping: Path | None = None,
    scheduler: str | None = None,
    workers: int | None = None,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Diagnose every recording by itself, each into a folder of its name; write table.csv and report.html of all.

    Args:
        places: recordings, or folders of recordings.
        output: folder of the folders. What an earlier run has completed there is kept.
        device: nominal device of all; None takes that of each recording.
        mapping: of all of them, see :func:`recon.io.convert.open_any`.
        scheduler, workers: see :func:`recon.runtime.executors.open_executor`; a cluster needs the same paths.
        overwrite: do everything anew.

    Returns:
        The summary. Its ``exit`` is 2 if an input was bad, 1 if another recording failed, else 0.

    Raises:
        BadInput: there is no recording, ``output`` holds results of other options, or no scheduler answers.
        InterruptedError: by the user. The folders of finished recordings remain.
    """
    from recon.io.output import finite, replacing_folder, write_json
    from recon.report.fleet import fleet_report
    from recon.runtime.fleet import find_recordings, plan_fleet, run_fleet, state_inputs
    from scanner import devices

    started, paths = time.perf_counter(), find_recordings(places)
    nominal = None if device is None else devices.find(device)
    stated = state_inputs(nominal, mapping)
    fleet = plan_fleet(paths, output, stated, "diagnosis.json", overwrite, ("verdict", "findings"))
    where = device if nominal is None or not Path(str(device)).is_file() else Path(str(device)).absolute()
    work = partial(_diagnose_one, where, mapping and mapping.absolute())
    failures = run_fleet(fleet, work, "diagnose", scheduler, workers)
    rows: list[dict[str, Any]] = []
    names = Counter(path.name for path in fleet.folders)
    for path, folder in fleet.folders.items():
        name = path.name if names[path.name] == 1 else str(path)
        if path in failures:
            rows.append({"recording": name, "failed": failures[path].reason})
        else:
            content = json.loads((folder / "diagnosis.json").read_text(encoding="utf-8"))
            rows += table_rows(name, (folder / "device.toml").read_text(encoding="utf-8"), content)
    summary: dict[str, Any] = finite(
        {
            "output": str(output),
            "recordings": len(fleet.folders),
            "failed": len(failures),
            "kept": len(fleet.done),
            "table": rows,
            "exit": max((failure.exit for failure in failures.values()), default=0),
            "seconds": time.perf_counter() - started,
        }
    )
    with replacing_folder(output) as folder:
        write_json(folder / "summary.json", summary)
        with (folder / "table.csv").open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, COLUMNS, restval="")
            writer.writeheader()
            writer.writerows(rows)
        (folder / "report.html").write_text(fleet_report(summary), encoding="utf-8")
    return summary


def _diagnose_one(device: str | Path | None, mapping: Path | None, path: Path, folder: Path) -> None:
    """Diagnose one recording in a worker."""
    diagnose_files([path], folder, device, mapping, quiet=True)


def table_rows(name: str, device_toml: str, content: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Lines of the table for one diagnosis.

    Args:
        name: of the recording.
        device_toml: its improved device, whose name is that of the nominal one.
        content: of diagnosis.json.
    """
    import tomllib

    own = {"recording": name, "device": tomllib.loads(device_toml).get("name", ""), "verdict": content["verdict"]}
    rows = []
    for finding in content["findings"]:
        common = own | {key: finding.get(key) for key in ("axis", "stage", "effect", "probability", "share")}
        for parameter in finding["parameters"] or [{}]:
            low, high = parameter.get("ci95") or (None, None)
            value = {"parameter": parameter.get("name"), "value": parameter.get("value"), "unit": parameter.get("unit")}
            rows.append(common | value | {"ci95_low": low, "ci95_high": high})
    return rows or [own]


def format_each(summary: Mapping[str, Any]) -> str:
    """Text for the terminal."""
    from recon.report.conclusions import conclude_fleet

    lines = [conclude_fleet(summary)]
    if summary["kept"]:
        lines.append(f"  {summary['kept']} were kept from an earlier run; --overwrite does them anew")
    lines += [f"  failed: {row['failed']}" for row in summary["table"] if row.get("failed")]
    return "\n".join([*lines, f"  table {summary['output']}/table.csv, report {summary['output']}/report.html"])
