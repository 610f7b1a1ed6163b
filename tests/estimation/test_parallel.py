"""Computations in threads, and in the calling thread where threads cost more than they save."""

import threading
from collections.abc import Callable
from typing import Any

import pytest

from estimation.parallel import MIN_STEPS_OF_THREADS, map_fits, map_parallel


@pytest.mark.parametrize("mapped", [map_parallel, map_fits])
@pytest.mark.parametrize(("steps", "here"), [(MIN_STEPS_OF_THREADS - 1, True), (MIN_STEPS_OF_THREADS, False)])
def test_only_long_recordings_use_threads(mapped: Callable[..., list[tuple[int, int]]], steps: int, here: bool) -> None:
    results = mapped(lambda item: (item, threading.get_ident()), range(5), steps)
    assert [item for item, _ in results] == [0, 1, 2, 3, 4]
    assert all((thread == threading.get_ident()) == here for _, thread in results)


@pytest.mark.parametrize("mapped", [map_parallel, map_fits])
def test_a_call_within_a_call_does_not_wait_for_its_own_thread(mapped: Callable[..., list[Any]]) -> None:
    def inner(item: int) -> list[int]:
        return mapped(lambda other: item * other, range(3), MIN_STEPS_OF_THREADS)

    results = list[list[list[int]]]()
    outer = threading.Thread(target=lambda: results.append(mapped(inner, range(5), MIN_STEPS_OF_THREADS)), daemon=True)
    outer.start()
    outer.join(timeout=10.0)
    assert results == [[[item * other for other in range(3)] for item in range(5)]]
