"""Independent computations in threads: compiled code and numpy release the interpreter lock."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
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

_PARTS = ThreadPoolExecutor(_PROCESSORS)
_FITS = ThreadPoolExecutor(MAX_PARALLEL_FITS)
"""Fits wait for their parts, so they have threads of their own."""


def map_parallel(function: Callable[[T], R], items: Iterable[T], steps: float = math.inf) -> list[R]:
    """``function`` of each item in order, one thread per processor. It must not call this function itself.

    Args:
        steps: integration steps of the recordings; below ``MIN_STEPS_OF_THREADS`` this thread computes all.
    """
    return list((map if steps < MIN_STEPS_OF_THREADS else _PARTS.map)(function, items))


def map_fits(function: Callable[[T], R], items: Iterable[T], steps: float) -> list[R]:
    """``function``, which makes fits one after the other, of each item, ``MAX_PARALLEL_FITS`` at a time, in order.

    A function that calls this one itself would wait for its own thread.

    Args:
        steps: as for :func:`map_parallel`.
    """
    return list((map if steps < MIN_STEPS_OF_THREADS else _FITS.map)(function, items))
