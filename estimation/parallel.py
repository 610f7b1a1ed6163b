"""Independent computations in threads: compiled code and numpy release the interpreter lock."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")

MAX_PARALLEL_FITS = 2
"""Fits at a time: one waits where the other's parts do not occupy all processors. Every fit holds a Jacobian of all
samples, so more fits would take much memory."""

_PROCESSORS = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()

_PARTS = ThreadPoolExecutor(_PROCESSORS)
_FITS = ThreadPoolExecutor(MAX_PARALLEL_FITS)
"""Fits wait for their parts, so they have threads of their own."""


def map_parallel(function: Callable[[T], R], items: Iterable[T]) -> list[R]:
    """``function`` of each item in order, one thread per processor. It must not call this function itself."""
    return list(_PARTS.map(function, items))


def map_fits(function: Callable[[T], R], items: Iterable[T]) -> list[R]:
    """``function``, which makes fits one after the other, of each item, ``MAX_PARALLEL_FITS`` at a time, in order.

    A function that calls this one itself would wait for its own thread.
    """
    return list(_FITS.map(function, items))
