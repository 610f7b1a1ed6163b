"""Ctrl-C and SIGTERM: a command that is told to stop stops, and is known to have been told so."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

AGAIN = 1.0  # s


class Stop:
    """Whether somebody told the process to stop."""

    came = False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Raise KeyboardInterrupt, and again where nothing came of it: compiled code may lose it in a callback.

        What is being handled when the signal comes, most of all the first KeyboardInterrupt itself, is left to tidy up.
        """
        self.came = True
        if hasattr(signal, "setitimer"):
            signal.signal(signal.SIGALRM, self)
            signal.setitimer(signal.ITIMER_REAL, AGAIN)
        if sys.exc_info()[0] is None:
            raise KeyboardInterrupt


@contextmanager
def stoppable() -> Iterator[Stop]:
    """Within the block SIGINT and SIGTERM raise KeyboardInterrupt; outside of the main thread nothing is changed."""
    stop = Stop()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    hook, sys.unraisablehook = sys.unraisablehook, _unless_stopped(sys.unraisablehook)
    try:
        yield stop
    finally:
        sys.unraisablehook = hook
        heard()
        for number, handler in before.items():
            signal.signal(number, handler if handler is not None else signal.SIG_DFL)


def _unless_stopped(hook: Callable[[Any], object]) -> Callable[[Any], object]:
    """The hook for exceptions that nobody can catch, without a word of a KeyboardInterrupt: it comes again."""
    return lambda lost: None if issubclass(lost.exc_type, KeyboardInterrupt) else hook(lost)


def heard() -> None:
    """Nothing more is to come of a stop, if one came: what was to stop has stopped."""
    if hasattr(signal, "setitimer") and isinstance(signal.getsignal(signal.SIGALRM), Stop):
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
