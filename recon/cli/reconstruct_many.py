"""``lissajous reconstruct`` with several recordings: a folder each, and a table and a page of all.

If one recording fails, the others are still reconstructed.
"""

from __future__ import annotations

import errno
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import CancelledError, Executor, Future, as_completed
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import TYPE_CHECKING, Any

from recon.cli.reconstruct import reconstruct_file

if TYPE_CHECKING:
    from recon.pipeline import Options

TABLE_KEYS = ("estimator", "samples", "fill", "phase_sd_deg", "within_bound", "sign", "trouble", "notes", "seconds")
"""Keys of one recording's summary that the summary of all repeats."""

Row = Mapping[str, Any]
"""One recording's entry in the summary of all."""


def reconstruct_files(
    paths: Sequence[Path],
    output: Path,
    options: Options,
    mapping: Path | None = None,
    scheduler: str | None = None,
    workers: int | None = None,
) -> dict[str, Any]:
    """Reconstruct recordings, each into a folder of its name in ``output``; write summary.json and index.html of all.

    Args:
        paths: the recordings.
        output: folder of the folders.
        options: of every reconstruction.
        mapping: of all of them, see :func:`recon.io.convert.open_any`.
        scheduler, workers: see :func:`recon.executors.open_executor`; a cluster reads and writes the same paths.

    Returns:
        The summary. Its ``exit`` is 2 if an input was bad, 1 if another recording failed, else 0.

    Raises:
        BadInput: ``output`` cannot be a folder, or no scheduler answers.
        InterruptedError: by the user. The folders of finished recordings remain.
    """
    from tqdm import tqdm

    from recon.executors import open_executor, picklable_task
    from recon.io.output import check_folder, finite, replacing_folder, write_json
    from recon.io.readers import registered
    from recon.report.many import reconstructions_report

    started, paths = time.perf_counter(), list(dict.fromkeys(paths))
    check_folder(output)
    with open_executor(scheduler, workers) as executor:
        output.mkdir(exist_ok=True)
        folders = dict(zip(paths, _folders(paths, output.absolute()), strict=True))
        jobs = {}
        for path, folder in folders.items():
            given = path.absolute(), folder, options, mapping and mapping.absolute(), registered()
            jobs[_submit(executor, picklable_task(_reconstruct_one, *given))] = path
        rows: dict[Path, Row] = {}
        try:
            for job in tqdm(as_completed(jobs), "reconstruct", len(jobs), unit="recording", file=sys.stderr):
                rows[jobs[job]] = _result_of(job, jobs[job])
        except KeyboardInterrupt:
            reason = f"interrupted; {len(rows)} of {len(paths)} recordings are done"
            raise InterruptedError(errno.EINTR, reason, str(output)) from None
    recordings = [{"recording": str(path), "output": str(folders[path]), **rows[path]} for path in folders]
    failed = [row for row in recordings if row["failed"]]
    summary = finite(
        {
            "output": str(output),
            "recordings": recordings,
            "failed": len(failed),
            "exit": max((row["exit"] for row in failed), default=0),
            "seconds": time.perf_counter() - started,
        }
    )
    with replacing_folder(output) as folder:
        write_json(folder / "summary.json", summary)
        (folder / "index.html").write_text(reconstructions_report(summary), encoding="utf-8")
    return dict(summary)


def _reconstruct_one(
    path: Path, folder: Path, options: Options, mapping: Path | None, reader_files: Sequence[Path]
) -> Row:
    """Reconstruct one recording in a worker; an expected error becomes a row that says why it failed."""
    from recon.io.readers import register
    from scanner.errors import BadInput, line_of

    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    for file in reader_files:
        register(file)
    try:
        summary = reconstruct_file(path, folder, options, mapping, quiet=True)
    except BadInput as error:
        return {"failed": str(error), "exit": 2}
    except MemoryError:
        return {"failed": f"{path}: needs more memory than there is; cut it into shorter ones", "exit": 2}
    except OSError as error:  # such as a full disk
        return {"failed": line_of(error, folder), "exit": 1}
    return {"failed": None} | {key: summary[key] for key in TABLE_KEYS}


def _submit(executor: Executor, work: Callable[[], Row]) -> Future[Row]:
    """Submit ``work``; return a failed future if a worker was killed before all jobs were submitted."""
    try:
        return executor.submit(work)
    except BrokenProcessPool as error:
        broken: Future[Row] = Future()
        broken.set_exception(error)
        return broken


def _result_of(job: Future[Row], path: Path) -> Row:
    try:
        return job.result()
    except (BrokenProcessPool, CancelledError) as error:
        return {"failed": f"{path}: its worker was killed (out of memory?): {error}", "exit": 1}


def _folders(paths: Sequence[Path], output: Path) -> list[Path]:
    """A folder for each recording, named after it; recordings of the same name get a number appended."""
    names: list[str] = []
    for path in paths:
        name, number = path.stem, 2
        while name in names:
            name, number = f"{path.stem}-{number}", number + 1
        names.append(name)
    return [output / name for name in names]


def format_summary(summary: dict[str, Any]) -> str:
    rows = summary["recordings"]
    lines = [f"{summary['output']}: {len(rows) - summary['failed']} of {len(rows)} recordings reconstructed"]
    for row in rows:
        if row["failed"]:
            lines.append(f"  failed: {row['failed']}")
        else:
            shares = ", ".join(f"{axis} {share:.1%}" for axis, share in row["within_bound"].items())
            lines.append(f"  {row['output']}: fill {row['fill']:.1%}, within the bound {shares}")
    return "\n".join([*lines, f"  table {summary['output']}/summary.json, page {summary['output']}/index.html"])
