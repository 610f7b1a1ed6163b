"""Compiled functions on disk are removed when code that they may contain has changed.

numba stores a compiled function beside its source and compiles it again when that file has changed. It does not notice
a change of another file whose functions are compiled into it, as after an update by git.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

_PACKAGES = ("scanner", "estimation", "recon")
"""Packages with compiled functions. Each uses those of its own and of the packages before it."""


def remove_outdated(root: Path) -> None:
    """Remove stored functions that are older than a source file with compiled functions that they may use.

    Args:
        root: the folder that contains the packages.
    """
    newest = 0.0
    for package in (root / name for name in _PACKAGES):
        sources = [path for path in package.rglob("*.py") if b"numba" in path.read_bytes()]
        newest = max([newest, *(path.stat().st_mtime for path in sources)])
        for stored in package.rglob("*.nbi"):
            with suppress(OSError):  # another process removes it too, or the folder is read-only
                if stored.stat().st_mtime < newest:
                    stored.unlink()
