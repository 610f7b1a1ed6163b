"""Ctrl-C and SIGTERM: make them stop a command reliably.

Imports nothing that imports numpy, because the command line imports this module before it sets up numpy.
"""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from scanner.files import HAS_REPLACED, IS_REPLACING

REPEAT_INTERVAL_S = 1.0
"""Time after which KeyboardInterrupt is raised again if the process still runs. Compiled code may discard the first
one in a callback; a second is long enough for an ordinary clean-up."""


class StopRequest:
    """Signal handler that records whether the process was asked to stop.

    Attributes:
        came: whether SIGINT or SIGTERM arrived before the work ended.
        was_postponed: whether one arrived while a finished file took its place, or after it.
        ended: whether the work has ended, so that nothing is left to stop.
    """

    came = False
    was_postponed = False
    ended = False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Raise KeyboardInterrupt, and again every ``REPEAT_INTERVAL_S`` until it is acknowledged.

        Nothing is raised while another exception is handled, above all the first KeyboardInterrupt: its clean-up runs
        to the end. Nothing is raised either when the work has ended: its output is in place. While a finished file
        takes its place, the interrupt waits for the next repetition; so does one after it, but only once: the command
        has usually done its work, and ends before that.
        """
        if self.ended and not self.came:
            return
        may_be_done = HAS_REPLACED.is_set() and not self.was_postponed
        is_late = (IS_REPLACING.is_set() or may_be_done) and hasattr(signal, "setitimer")
        self.came = self.came or not is_late
        self.was_postponed = self.was_postponed or is_late
        if hasattr(signal, "setitimer"):
            signal.signal(signal.SIGALRM, self)
            signal.setitimer(signal.ITIMER_REAL, REPEAT_INTERVAL_S)
        if not is_late and sys.exc_info()[0] is None:
            raise KeyboardInterrupt


@contextmanager
def handle_interrupts() -> Iterator[StopRequest]:
    """Make SIGINT and SIGTERM raise KeyboardInterrupt within the block.

    Outside the main thread nothing is changed, because Python sets signal handlers there only.
    """
    stop = StopRequest()
    HAS_REPLACED.clear()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    hook, sys.unraisablehook = sys.unraisablehook, _silence_interrupts(sys.unraisablehook)
    try:
        yield stop
    finally:
        sys.unraisablehook = hook
        acknowledge_stop()
        for number, handler in before.items():
            signal.signal(number, handler if handler is not None else signal.SIG_DFL)


def _silence_interrupts(hook: Callable[[Any], object]) -> Callable[[Any], object]:
    """The hook for unraisable exceptions without messages about KeyboardInterrupt, which is raised again anyway."""
    return lambda lost: None if issubclass(lost.exc_type, KeyboardInterrupt) else hook(lost)


def acknowledge_stop() -> None:
    """End the repetition of a KeyboardInterrupt. Call it where the interrupted work has ended."""
    if hasattr(signal, "setitimer") and isinstance(signal.getsignal(signal.SIGALRM), StopRequest):
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
