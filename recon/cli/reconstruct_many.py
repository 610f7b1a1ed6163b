"""``lissajous reconstruct`` with several recordings: a folder each, and a table and a page of all.

If one recording fails, the others are still reconstructed.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from recon.cli.reconstruct import reconstruct_file
from scanner.wording import counted

if TYPE_CHECKING:
    from recon.steps.reconstruction import Options

TABLE_KEYS = (
    "estimator", "samples", "fill", "phase_sd_deg", "within_bound", "sign", "trouble", "limits", "notes", "seconds",
)  # fmt: skip
"""Keys of one recording's summary that the summary of all repeats."""

STACK_FILES = ("stack.ome.tif", "stack_sd.ome.tif", "stack.ome.zarr", "stack.mp4", "stack.gif")
"""Files of the output that a stack gives only."""


class StackOptions(NamedTuple):
    """A stack of several recordings, with the distance of one plane from the next [m]; None for that of position_z."""

    spacing: float | None


Row = Mapping[str, Any]
"""One recording's entry in the summary of all."""


def reconstruct_files(
    paths: Sequence[Path],
    output: Path,
    options: Options,
    mapping: Path | None = None,
    scheduler: str | None = None,
    workers: int | None = None,
    overwrite: bool = False,
    stack: StackOptions | None = None,
) -> dict[str, Any]:
    """Reconstruct recordings, each into a folder of its name in ``output``; write summary.json and index.html of all.

    Args:
        paths: the recordings.
        output: folder of the folders. What an earlier run has completed there is kept.
        options: of every reconstruction.
        mapping: of all of them, see :func:`recon.io.convert.open_any`.
        scheduler, workers: see :func:`recon.runtime.executors.open_executor`; a cluster needs the same paths.
        overwrite: do everything anew.
        stack: write the pictures as one stack too, unless a recording fails; None for no stack.

    Returns:
        The summary. Its ``exit`` is 2 if an input was bad, 1 if another recording failed, else 0.

    Raises:
        BadInput: ``output`` cannot be a folder or holds results of other options, no scheduler answers, or the pictures
            are no stack.
        InterruptedError: by the user. The folders of finished recordings remain.
    """
    from dataclasses import replace

    from recon.io.output import finite, replacing_folder, write_json
    from recon.report.many import reconstructions_report
    from recon.runtime.fleet import find_recordings, plan_fleet, run_fleet, state_inputs
    from recon.sequences.recording_stack import read_planes, write_recording_stack

    started, paths = time.perf_counter(), find_recordings(paths)
    alone = options if options.wants_frames else replace(options, zarr=False, movie=None)  # a stack's own options
    stated = f"{replace(alone, device=None)} {state_inputs(options.device, mapping)}"
    fleet = plan_fleet(paths, output, stated, "summary.json", overwrite, TABLE_KEYS)
    work = partial(_reconstruct_one, options, mapping and mapping.absolute())
    failures = run_fleet(fleet, work, "reconstruct", scheduler, workers)
    rows: list[Row] = []
    for path, folder in fleet.folders.items():
        row = {"recording": str(path), "output": str(folder)}
        if path in failures:
            rows.append(row | {"failed": failures[path].reason, "exit": failures[path].exit})
        else:
            summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
            rows.append(row | {"failed": None} | {key: summary[key] for key in TABLE_KEYS})
    failed = [row for row in rows if row["failed"]]
    with replacing_folder(output, optional=STACK_FILES) as folder:
        made = None
        if stack is not None and not failed:
            made = write_recording_stack(folder, read_planes(fleet.folders), stack.spacing, options.zarr, options.movie)
        content = finite(
            {
                "output": str(output),
                "recordings": rows,
                "failed": len(failed),
                "kept": len(fleet.done),
                "stack": made,
                "exit": max((row["exit"] for row in failed), default=0),
                "seconds": time.perf_counter() - started,
            }
        )
        write_json(folder / "summary.json", content)
        (folder / "index.html").write_text(reconstructions_report(content), encoding="utf-8")
    return dict(content)


def _reconstruct_one(options: Options, mapping: Path | None, path: Path, folder: Path) -> None:
    """Reconstruct one recording in a worker."""
    reconstruct_file(path, folder, options, mapping, quiet=True)


def format_summary(summary: dict[str, Any]) -> str:
    from recon.report.conclusions import describe_stack

    rows = summary["recordings"]
    lines = [f"{summary['output']}: {len(rows) - summary['failed']} of {counted(len(rows), 'recording')} reconstructed"]
    if summary["kept"]:
        lines.append(f"  {summary['kept']} were kept from an earlier run; --overwrite does them anew")
    if summary["stack"]:
        lines.append(f"  {describe_stack(summary['stack'])}: {summary['output']}/stack.ome.tif")
        lines += [f"  {note}" for note in summary["stack"]["notes"]]
    for row in rows:
        if row["failed"]:
            lines.append(f"  failed: {row['failed']}")
        else:
            shares = ", ".join(f"{axis} {share:.1%}" for axis, share in row["within_bound"].items())
            lines.append(f"  {row['output']}: fill {row['fill']:.1%}, within the bound {shares}")
            lines += [f"    {limit}" for limit in row["limits"]]
    return "\n".join([*lines, f"  table {summary['output']}/summary.json, page {summary['output']}/index.html"])
