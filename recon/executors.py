"""Where many jobs run: on the machine's cores, or on a Dask cluster."""

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

from scanner.errors import BadInput
from scanner.terms import register, registered

T = TypeVar("T")


def executor_of(scheduler: str | None = None, workers: int | None = None) -> AbstractContextManager[Executor]:
    """An executor, for a ``with`` statement.

    Args:
        scheduler: address of a Dask scheduler; the machine's own cores without one.
        workers: processes on this machine; one a core if not given.

    Raises:
        BadInput: Dask is not installed, or no scheduler answers at the address.
    """
    return _cluster(scheduler) if scheduler else _processes(workers)


def task(work: Callable[..., T], *given: object) -> Callable[[], T]:
    """``work(*given)`` for an executor: whoever does it knows the users' term files that this process knows."""
    return partial(_informed, registered(), work, *given)


def _informed(files: tuple[Path, ...], work: Callable[..., T], *given: object) -> T:
    for path in files:
        if path not in registered():
            register(path)
    return work(*given)


@contextmanager
def _processes(workers: int | None) -> Iterator[Executor]:
    # Spawned, not forked: a fork of a process with threads (OpenCV's, a test's) can lock up.
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(workers, context, _worker_begins)
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)


def _worker_begins() -> None:
    """A worker leaves the interrupt to its parent, and ends when that is killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def _cluster(address: str) -> Iterator[Executor]:
    """A Dask cluster as an executor: its scheduler gives the jobs of a worker that died to the others."""
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
