"""Many recordings at once: a folder each, a table and a page of all. One that fails does not stop the others."""

from __future__ import annotations

import errno
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import CancelledError, Executor, Future, as_completed
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any
from urllib.parse import quote

from recon.executors import executor_of, task
from recon.output import check_folder, finite, replacing_folder, write_json
from recon.pipeline import AXES, Options
from recon.reconstructing import reconstruct_file
from scanner.errors import BadInput, line_of

KEPT = ("estimator", "samples", "fill", "phase_sd_deg", "within_bound", "sign", "trouble", "notes", "seconds")
Row = Mapping[str, Any]


def reconstruct_files(
    paths: Sequence[Path],
    output: Path,
    options: Options,
    mapping: Path | None = None,
    scheduler: str | None = None,
    workers: int | None = None,
) -> dict[str, Any]:
    """Reconstruct recordings, each into a folder of its name in ``output``, with summary.json and index.html of all.

    Args:
        mapping: of all of them, see :func:`recon.convert.open_any`.
        scheduler, workers: see :func:`recon.executors.executor_of`; a cluster reads and writes the same paths.

    Returns:
        The summary; ``exit`` in it is 2 where an input was bad, 1 where another failed, else 0.

    Raises:
        BadInput: ``output`` is no place for a folder, or no scheduler answers.
        InterruptedError: by the user; the folders of those that are done stay.
    """
    from tqdm import tqdm

    began, paths = time.perf_counter(), list(dict.fromkeys(paths))
    check_folder(output)
    pool = executor_of(scheduler, workers)
    with pool as executor:
        output.mkdir(exist_ok=True)
        folders = dict(zip(paths, _folders(paths, output.absolute()), strict=True))
        jobs = {
            _submitted(executor, task(_one, path.absolute(), folder, options, mapping and mapping.absolute())): path
            for path, folder in folders.items()
        }
        rows: dict[Path, Row] = {}
        try:
            for done in tqdm(as_completed(jobs), "reconstruct", len(jobs), unit="recording", file=sys.stderr):
                rows[jobs[done]] = _row(done, jobs[done])
        except KeyboardInterrupt:
            why = f"interrupted; {len(rows)} of {len(paths)} recordings are done"
            raise InterruptedError(errno.EINTR, why, str(output)) from None
    recordings = [{"recording": str(path), "output": str(folders[path]), **rows[path]} for path in folders]
    failed = [each for each in recordings if each["failed"]]
    summary = finite(
        {
            "output": str(output),
            "recordings": recordings,
            "failed": len(failed),
            "exit": max((each["exit"] for each in failed), default=0),
            "seconds": time.perf_counter() - began,
        }
    )
    with replacing_folder(output) as folder:
        write_json(folder / "summary.json", summary)
        (folder / "index.html").write_text(_page(summary), encoding="utf-8")
    return dict(summary)


def _one(path: Path, folder: Path, options: Options, mapping: Path | None) -> Row:
    """What the table says of one recording, done or failed."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        summary = reconstruct_file(path, folder, options, mapping, quiet=True)
    except BadInput as error:
        return {"failed": str(error), "exit": 2}
    except MemoryError:
        return {"failed": f"{path}: needs more memory than there is; cut it into shorter ones", "exit": 2}
    except OSError as error:  # a full disk
        return {"failed": line_of(error, folder), "exit": 1}
    return {"failed": None} | {key: summary[key] for key in KEPT}


def _submitted(executor: Executor, work: Callable[[], Row]) -> Future[Row]:
    """The future of ``work``; one that failed if a worker was killed while others were still being submitted."""
    try:
        return executor.submit(work)
    except BrokenProcessPool as error:
        broken: Future[Row] = Future()
        broken.set_exception(error)
        return broken


def _row(done: Future[Row], path: Path) -> Row:
    try:
        return done.result()
    except (BrokenProcessPool, CancelledError) as error:
        return {"failed": f"{path}: its worker was killed (out of memory?): {error}", "exit": 1}


def _folders(paths: Sequence[Path], output: Path) -> list[Path]:
    """A folder for each recording, by its name; a number behind the name tells those of the same name apart."""
    names: list[str] = []
    for path in paths:
        name, number = path.stem, 2
        while name in names:
            name, number = f"{path.stem}-{number}", number + 1
        names.append(name)
    return [output / name for name in names]


def _page(summary: Mapping[str, Any]) -> str:
    from recon.report import Figure, Section, Table, render

    done = [each for each in summary["recordings"] if not each["failed"]]
    heads = ["recording", "samples", "fill", *(f"within ±p/m, {a}" for a in AXES), *(f"phase sd {a} [°]" for a in AXES)]
    rows = [
        [
            Path(each["output"]).name,
            str(each["samples"]),
            f"{each['fill']:.1%}",
            *(f"{each['within_bound'][axis]:.1%}" for axis in AXES),
            *(f"{each['phase_sd_deg'][axis]:.4f}" for axis in AXES),
            str(len(each["trouble"])),
        ]
        for each in done
    ]
    names = [Path(each["output"]).name for each in done]
    pictures = [Figure(f"{quote(name)}/image.png", name, f"{quote(name)}/report.html") for name in names]
    sections = [
        Section("Recordings", "", Table([*heads, "stretches of trouble"], rows)),
        Section("Pictures", "Each leads to its report.", figures=pictures, pixelated=True),
    ]
    lead = f"{len(done)} of {len(summary['recordings'])} recordings reconstructed in {summary['seconds']:.1f} s."
    failed = [each["failed"] for each in summary["recordings"] if each["failed"]]
    return render("Reconstructions", lead, sections, failed)
