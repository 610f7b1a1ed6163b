"""Independent computations in threads: compiled code and numpy release the interpreter lock."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from threading import current_thread
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")

MAX_PARALLEL_FITS = 2
"""Fits at a time: one waits where the other's parts do not occupy all processors. Every fit holds a Jacobian of all
samples, so more fits would take much memory."""

MIN_STEPS_OF_THREADS = 50_000
"""Integration steps of all axes and recordings from which threads are used. Between the calls of compiled code the
interpreter runs one thread at a time and hands over slowly: with 500 to 4 500 steps a diagnosis took 1.2 to 1.5 times
as long in two threads as in one, with 20 000 as long with 1.2 times the processor time."""

_PROCESSORS = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()

_PART, _FIT = "part", "fit"
_PARTS = ThreadPoolExecutor(_PROCESSORS, thread_name_prefix=_PART)
_FITS = ThreadPoolExecutor(MAX_PARALLEL_FITS, thread_name_prefix=_FIT)
"""Fits wait for their parts, so they have threads of their own. The names show to which of the two a thread belongs."""


def map_parallel(function: Callable[[T], R], items: Iterable[T], steps: float = math.inf) -> list[R]:
    """``function`` of each item in order, one thread per processor.

    Where a function calls this one itself, the inner call computes all items: it would wait for its own thread.

    Args:
        steps: integration steps of the recordings; below ``MIN_STEPS_OF_THREADS`` this thread computes all.
    """
    return _map(_PARTS, _PART, function, items, steps)


def map_fits(function: Callable[[T], R], items: Iterable[T], steps: float) -> list[R]:
    """``function``, which makes fits one after the other, of each item, ``MAX_PARALLEL_FITS`` at a time, in order.

    A call within a call, and ``steps``, are as in :func:`map_parallel`.
    """
    return _map(_FITS, _FIT, function, items, steps)


def _map(
    threads: ThreadPoolExecutor, name: str, function: Callable[[T], R], items: Iterable[T], steps: float
) -> list[R]:
    is_inner = current_thread().name.startswith(name)
    return list((map if is_inner or steps < MIN_STEPS_OF_THREADS else threads.map)(function, items))
