"""A message while numerical code is compiled, at the first run of a command, which takes one to three minutes."""

from __future__ import annotations

import sys
from functools import cache
from typing import Any


@cache
def announce_compilation() -> None:
    """From now on write to stderr that code is compiled, and on a terminal how many functions were."""
    from numba.core import event
    from numba.core.caching import NullCache

    class Announcer(event.Listener):
        """Counts the functions that are compiled to be cached; others are parts of these.

        On a terminal the count is erased when the compilation ends, so that what is printed next begins its own line.
        """

        functions = 0
        nesting = 0
        count = ""

        def on_start(self, started: Any) -> None:
            self.nesting += 1
            if isinstance(getattr(started.data.get("dispatcher"), "_cache", None), NullCache):
                return
            if self.functions == 0:
                print("compiling, once (one to three minutes)", file=sys.stderr, flush=True)
            self.functions += 1
            if sys.stderr.isatty():
                self.count = f"functions: {self.functions}"
                print(f"\r{self.count}", end="", file=sys.stderr, flush=True)

        def on_end(self, ended: Any) -> None:
            self.nesting -= 1
            if self.count and self.nesting == 0:
                print(f"\r{' ' * len(self.count)}\r", end="", file=sys.stderr, flush=True)
                self.count = ""

    event.register("numba:compile", Announcer())
