"""Computations in threads, and in the calling thread where threads cost more than they save."""

import threading
from collections.abc import Callable

import pytest

from estimation.parallel import MIN_STEPS_OF_THREADS, map_fits, map_parallel


@pytest.mark.parametrize("mapped", [map_parallel, map_fits])
@pytest.mark.parametrize(("steps", "here"), [(MIN_STEPS_OF_THREADS - 1, True), (MIN_STEPS_OF_THREADS, False)])
def test_only_long_recordings_use_threads(mapped: Callable[..., list[tuple[int, int]]], steps: int, here: bool) -> None:
    results = mapped(lambda item: (item, threading.get_ident()), range(5), steps)
    assert [item for item, _ in results] == [0, 1, 2, 3, 4]
    assert all((thread == threading.get_ident()) == here for _, thread in results)
