"""Running a study: what is done stands in a journal, the rest goes to the machine's cores or to a Dask cluster.

The journal ``cells.jsonl`` in the output folder has a line for each cell, written by this process alone when a job
comes back and forced to disk before the next is taken: a study that is killed at any moment goes on from there.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, as_completed
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from tqdm import tqdm

from recon.executors import executor_of, task
from recon.output import check_folder, finite, replacing_folder, write_json
from recon.study.plan import Job, jobs, key, read_study, remaining
from recon.study.table import columns, require_parquet, rows, statistics, write_csv, write_parquet
from recon.study.world import do
from scanner.errors import BadInput

JOURNAL = "cells.jsonl"
Record = Mapping[str, Any]


def run_study(
    path: Path, output: Path, *, scheduler: str | None = None, workers: int | None = None, parquet: bool = False
) -> dict[str, Any]:
    """Do what is left of a study and write its table, summary.json and report.html into ``output``.

    Args:
        scheduler: address of a Dask scheduler; the machine's own cores without one.
        workers: processes on this machine; one a core if not given.
        parquet: write the table as Parquet too.

    Returns:
        The summary.

    Raises:
        BadInput: the study, the folder or the scheduler does not serve.
        OSError: interrupted, or the workers are gone; what is done is kept and the line says so.
    """
    from recon.study.report import study_report

    began = time.perf_counter()
    study = read_study(path)
    if parquet:
        require_parquet()
    everything = list(jobs(study))
    # The pool comes first: a scheduler that does not answer leaves no folder behind.
    pool = executor_of(scheduler, workers)
    with _telling(output), pool as executor, _journal(_folder(output) / JOURNAL) as (file, done):
        before = len(done)
        left = remaining(everything, done)
        if left:
            _work(executor, left, done, file, sum(1 for job in everything for _ in job.cells()))
        records = [done[key(cell)] for job in everything for cell in job.cells()]
        table = rows(records)
        summary = finite(
            {
                "study": study.name,
                "output": str(output),
                "cells": len(records),
                "computed": len(done) - before,
                "failed": sum("failed" in record for record in records),
                "reasons": sorted({record["failed"] for record in records if "failed" in record}),
                "rows": len(table),
                "estimators": statistics(table),
                "seconds": time.perf_counter() - began,
            }
        )
        with replacing_folder(output) as folder:
            write_csv(folder / "table.csv", table)
            if parquet:
                write_parquet(folder / "table.parquet", table)
            write_json(folder / "summary.json", summary)
            (folder / "report.html").write_text(study_report(study, columns(table), summary), encoding="utf-8")
            shutil.copyfile(path, folder / "study.toml")
    return dict(summary)


def _folder(output: Path) -> Path:
    """The folder, made where it is not there yet."""
    check_folder(output)
    output.mkdir(exist_ok=True)
    return output


@contextmanager
def _telling(output: Path) -> Iterator[None]:
    """What stops a study, in one line that says what became of the work."""
    try:
        yield
    except KeyboardInterrupt:
        raise _stopped(InterruptedError, errno.EINTR, "interrupted", output) from None
    except OSError as error:
        error.filename = error.filename or str(output)  # a full disk does not say where
        raise
    except BrokenExecutor:
        raise _stopped(ChildProcessError, errno.ECHILD, "a worker was killed (out of memory?)", output) from None
    except CancelledError:
        raise _stopped(ConnectionAbortedError, errno.ECONNABORTED, "the scheduler is gone", output) from None


def _stopped(kind: type[OSError], number: int, why: str, output: Path) -> OSError:
    return kind(number, f"{why}; what was done is kept, the same command goes on from there", str(output))


@contextmanager
def _journal(path: Path) -> Iterator[tuple[IO[bytes], dict[str, Record]]]:
    """The journal, open at its end, and its records by the key of their cell.

    Raises:
        BadInput: another process writes it, or a line in its midst is no record.
    """
    import fcntl

    with path.open("ab+") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            hint = "wait for it, or name another"
            raise BadInput("another run writes into this folder", file=path, hint=hint) from None
        file.seek(0)
        text = file.read()
        whole = text.rfind(b"\n") + 1
        file.truncate(whole)  # a line that a kill cut short: its cell counts as not done
        done: dict[str, Record] = {}
        for number, line in enumerate(text[:whole].splitlines(), 1):
            try:
                found = json.loads(line)
                done[key(found["cell"])] = found
            except (ValueError, KeyError, TypeError):
                raise BadInput(f"line {number} is no record of a cell", file=path, hint="remove the line") from None
        yield file, done


def _work(executor: Executor, left: Sequence[Job], done: dict[str, Record], file: IO[bytes], total: int) -> None:
    """Do the jobs, write each one's records when it comes back, and tell the time that is left."""
    with tqdm(
        total=total,
        initial=total - sum(1 for job in left for _ in job.cells()),
        desc="blur-study",
        unit="cell",
        smoothing=0.0,  # cells differ by a factor of ten: the mean of all tells the time left best
        file=sys.stderr,
        mininterval=0.5 if sys.stderr.isatty() else 30.0,
    ) as bar:
        for future in as_completed([executor.submit(task(do, each)) for each in left]):
            records = future.result()
            file.write(b"".join(json.dumps(each).encode() + b"\n" for each in records))
            file.flush()
            os.fsync(file.fileno())
            done.update((key(each["cell"]), each) for each in records)
            bar.update(len(records))
