"""A message while numerical code is compiled, which happens at the first run of a command and takes about a minute."""

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
        """Counts the functions that are compiled to be cached; others are parts of these."""

        functions = 0

        def on_start(self, started: Any) -> None:
            if isinstance(getattr(started.data.get("dispatcher"), "_cache", None), NullCache):
                return
            if self.functions == 0:
                print("compiling, once (about a minute)", file=sys.stderr, flush=True)
            self.functions += 1
            if sys.stderr.isatty():
                print(f"\r{self.functions} functions", end="", file=sys.stderr, flush=True)

        def on_end(self, ended: Any) -> None:
            """The next start reports the progress."""

    event.register("numba:compile", Announcer())
