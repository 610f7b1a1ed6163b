"""Executors for many jobs: processes on this machine, or a Dask cluster."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path
from typing import TypeVar

import estimation.estimators as estimators
import scanner.terms as terms
from scanner.errors import BadInput

T = TypeVar("T")


def open_executor(scheduler: str | None = None, workers: int | None = None) -> AbstractContextManager[Executor]:
    """Return an executor for a ``with`` statement: processes on this machine, or a Dask cluster.

    Args:
        scheduler: address of a Dask scheduler; None for processes on this machine.
        workers: number of processes on this machine; None for one per core.

    Raises:
        BadInput: Dask is not installed, or no scheduler answers at the address.
    """
    return _dask_cluster(scheduler) if scheduler else _process_pool(workers)


def picklable_task(work: Callable[..., T], *arguments: object) -> Callable[[], T]:
    """Return ``work(*arguments)`` as a call that an executor can send to a worker.

    The worker first registers the user's files of terms and estimators that are registered in this process.
    """
    return partial(_with_registered_files, terms.registered(), estimators.registered(), work, *arguments)


def _with_registered_files(
    term_files: tuple[Path, ...], estimator_files: tuple[Path, ...], work: Callable[..., T], *arguments: object
) -> T:
    """Register users' files, then do the work."""
    for path in term_files:
        if path not in terms.registered():
            terms.register(path)
    for path in estimator_files:
        if path not in estimators.registered():
            estimators.register(path)
    return work(*arguments)


@contextmanager
def _process_pool(workers: int | None) -> Iterator[Executor]:
    """A pool of spawned processes. A fork of a process with threads (of OpenCV, for example) can deadlock."""
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(workers, context, _start_worker)
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)


def _start_worker() -> None:
    """Leave interrupts to the parent process, and end when the parent is killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """Wait for the parent process to end, then end this one."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def _dask_cluster(address: str) -> Iterator[Executor]:
    """A Dask cluster as an executor. Its scheduler reassigns the jobs of a worker that terminates."""
    try:
        from distributed import Client
        from distributed.scheduler import KilledWorker
    except ModuleNotFoundError:
        raise BadInput("--scheduler needs Dask", hint="pip install 'lissajous[dask]'") from None
    try:
        client = Client(address, timeout=10, set_as_default=False)
    except (OSError, ValueError) as error:
        hint = "start one with: dask scheduler"
        raise BadInput(f"no Dask scheduler answers at {address} ({error})", hint=hint) from None
    with client:
        executor = client.get_executor(pure=False)
        try:
            yield executor
        except KilledWorker as error:
            raise BrokenExecutor(str(error)) from None
        finally:
            executor.shutdown(wait=False)
