"""Progress of a command whose stages have unknown lengths: one line on a terminal, a line for each stage elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

SILENT_S = 5.0
"""Time [s] for which a command writes no stages into a log file: short ones leave it to results and error messages."""


HOW_TO_SHORTEN = "a part of the recording takes less time, lissajous.Recording.open(FILE).slice(T0, T1).write(PART)"
"""What a user can do about a command that takes too long, whose results an interrupt loses."""


@contextmanager
def stage_progress(quiet: bool) -> Iterator[Callable[[str], None]]:
    """Yield the function that shows on stderr which stage begins, with the time since the start.

    On a terminal the stages replace each other in one line, which disappears at the end. Elsewhere each is a line. An
    interrupt writes one more line: the stage that it ended, and how the work takes less time.
    """
    if quiet:
        yield lambda stage: None
        return
    reached = "start"
    try:
        with _stage_display(time.perf_counter()) as show:

            def begin(stage: str) -> None:
                nonlocal reached
                reached = stage
                show(stage)

            yield begin
    except KeyboardInterrupt:
        print(f"stopped during: {reached}; {HOW_TO_SHORTEN}", file=sys.stderr, flush=True)
        raise


@contextmanager
def _stage_display(began: float) -> Iterator[Callable[[str], None]]:
    """Yield the function that shows a stage: in one line of a terminal, or as a line of a log file."""
    if sys.stderr.isatty():
        from tqdm import tqdm

        with tqdm(file=sys.stderr, bar_format="{elapsed} {desc}", leave=False) as bar:
            yield bar.set_description_str
    else:
        yield lambda stage: _write_stage(stage, time.perf_counter() - began)


def _write_stage(stage: str, elapsed: float) -> None:
    """Write a line on a stage that begins after the command has run for some time [s]."""
    if elapsed > SILENT_S:
        print(f"{elapsed:.0f} s  {stage}", file=sys.stderr, flush=True)
