"""Progress of a command whose stages have unknown lengths: one line on a terminal, a line for each stage elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

SILENT_S = 5.0
"""Time [s] for which a command writes no stages into a log file: short ones leave it to results and error messages."""


@contextmanager
def stage_progress(quiet: bool) -> Iterator[Callable[[str], None]]:
    """Yield the function that shows on stderr which stage begins, with the time since the start.

    On a terminal the stages replace each other in one line, which disappears at the end. Elsewhere each is a line.
    """
    if quiet:
        yield lambda stage: None
    elif sys.stderr.isatty():
        from tqdm import tqdm

        with tqdm(file=sys.stderr, bar_format="{elapsed} {desc}", leave=False) as bar:
            yield bar.set_description_str
    else:
        began = time.perf_counter()
        yield lambda stage: _write_stage(stage, time.perf_counter() - began)


def _write_stage(stage: str, elapsed: float) -> None:
    """Write a line on a stage that begins after the command has run for some time [s]."""
    if elapsed > SILENT_S:
        print(f"{elapsed:.0f} s  {stage}", file=sys.stderr, flush=True)
