"""Execution of a study: finished cells are in a journal, the others run on this machine's cores or a Dask cluster.

The journal ``cells.jsonl`` in the output folder has a line for each cell. This process alone writes it, when a job
returns, and forces it to disk before the next result is processed. A study that is killed continues from there.
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

from recon.io.output import check_folder, finite, replacing_folder, write_json
from recon.report.conclusions import conclude_study
from recon.runtime.executors import open_executor, picklable_task
from recon.study.job import check_scenarios, run_job
from recon.study.plan import Job, cell_key, plan_jobs, read_study, remaining_jobs
from recon.study.table import estimator_statistics, require_parquet, table_columns, table_rows, write_csv, write_parquet
from scanner.errors import BadInput
from scanner.files import lock_file

JOURNAL = "cells.jsonl"
Record = Mapping[str, Any]


def run_study(
    path: Path, output: Path, *, scheduler: str | None = None, workers: int | None = None, parquet: bool = False
) -> dict[str, Any]:
    """Run the unfinished jobs of a study and write its table, summary.json and report.html into ``output``.

    Args:
        path: of the study's TOML file.
        output: folder, new or of the same study.
        scheduler: address of a Dask scheduler; None for processes on this machine.
        workers: number of processes on this machine; None for one per core.
        parquet: also write the table as Parquet.

    Returns:
        The summary.

    Raises:
        BadInput: the study, the folder or the scheduler cannot be used.
        OSError: interrupted, or a worker ended; finished cells are kept, and the message says so.
    """
    from recon.study.report import study_report

    began = time.perf_counter()
    study = read_study(path)
    if parquet:
        require_parquet()
    all_jobs = list(plan_jobs(study))
    check_scenarios(job.scenario for job in all_jobs)
    # The pool comes first: a scheduler that does not answer must not cause an empty folder.
    pool = open_executor(scheduler, workers)
    with _explain_interruption(output), pool as executor, _journal(_create_folder(output) / JOURNAL) as (file, done):
        before = len(done)
        left = remaining_jobs(all_jobs, done)
        if left:
            _run_jobs(executor, left, done, file, sum(1 for job in all_jobs for _ in job.cells()))
        records = [done[cell_key(cell)] for job in all_jobs for cell in job.cells()]
        table = table_rows(records)
        failed = sum("failed" in record for record in records)
        summary = finite(
            {
                "study": study.name,
                "output": str(output),
                "cells": len(records),
                "computed": len(done) - before,
                "failed": failed,
                "reasons": sorted({record["failed"] for record in records if "failed" in record}),
                "rows": len(table),
                "estimators": estimator_statistics(table),
                "exit": 2 if failed == len(records) else 0,
                "seconds": time.perf_counter() - began,
            }
        )
        summary["conclusion"] = conclude_study(summary)
        with replacing_folder(output, optional=["table.parquet"]) as folder:
            write_csv(folder / "table.csv", table)
            if parquet:
                write_parquet(folder / "table.parquet", table)
            write_json(folder / "summary.json", summary)
            (folder / "report.html").write_text(study_report(study, table_columns(table), summary), encoding="utf-8")
            shutil.copyfile(path, folder / "study.toml")
    return dict(summary)


def _create_folder(output: Path) -> Path:
    """The folder, created if it does not exist."""
    check_folder(output)
    output.mkdir(exist_ok=True)
    return output


@contextmanager
def _explain_interruption(output: Path) -> Iterator[None]:
    """Turn what interrupts a study into an OSError whose message says that finished cells are kept."""
    try:
        yield
    except KeyboardInterrupt:
        raise _interruption_error(InterruptedError, errno.EINTR, "interrupted", output) from None
    except OSError as error:
        error.filename = error.filename or str(output)  # the error of a full disk names no file
        raise
    except BrokenExecutor:
        raise _interruption_error(
            ChildProcessError, errno.ECHILD, "a worker was killed (out of memory?)", output
        ) from None
    except CancelledError:
        raise _interruption_error(
            ConnectionAbortedError, errno.ECONNABORTED, "the connection to the scheduler is lost", output
        ) from None


def _interruption_error(kind: type[OSError], number: int, reason: str, output: Path) -> OSError:
    return kind(number, f"{reason}; finished jobs are kept, the same command continues with the others", str(output))


@contextmanager
def _journal(path: Path) -> Iterator[tuple[IO[bytes], dict[str, Record]]]:
    """The journal, open at its end, and its records by ``cell_key``.

    Raises:
        BadInput: another process writes it, or a line before the last one is not a record.
    """
    with path.open("ab+") as file:
        try:
            lock_file(file)
        except OSError:
            hint = "wait for it, or name another"
            raise BadInput("another run writes into this folder", file=path, hint=hint) from None
        file.seek(0)
        text = file.read()
        whole = text.rfind(b"\n") + 1
        file.truncate(whole)  # an incomplete last line of a killed run: its cell is repeated
        done: dict[str, Record] = {}
        for number, line in enumerate(text[:whole].splitlines(), 1):
            try:
                record = json.loads(line)
                done[cell_key(record["cell"])] = record
            except (ValueError, KeyError, TypeError):
                raise BadInput(f"line {number} is no record of a cell", file=path, hint="remove the line") from None
        yield file, done


def _run_jobs(executor: Executor, left: Sequence[Job], done: dict[str, Record], file: IO[bytes], total: int) -> None:
    """Run the jobs, write the records of each when it returns, and show the remaining time."""
    with tqdm(
        total=total,
        initial=total - sum(1 for job in left for _ in job.cells()),
        desc="blur-study",
        unit="cell",
        smoothing=0.0,  # cells differ by a factor of ten, so the mean over all predicts best
        file=sys.stderr,
        mininterval=0.5 if sys.stderr.isatty() else 30.0,
    ) as bar:
        for future in as_completed([executor.submit(picklable_task(run_job, each)) for each in left]):
            records = future.result()
            file.write(b"".join(json.dumps(each).encode() + b"\n" for each in records))
            file.flush()
            os.fsync(file.fileno())
            done.update((cell_key(each["cell"]), each) for each in records)
            bar.update(len(records))
