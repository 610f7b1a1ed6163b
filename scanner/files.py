"""Writing a file so that nobody ever meets half of one."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from scanner.errors import BadInput


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """A path to write to, beside ``path``: it takes ``path``'s place when the block ends and vanishes when it fails.

    Raises:
        BadInput: the folder of ``path`` does not exist, or ``path`` is a folder.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise BadInput("the folder to write into does not exist", file=path, hint=f"create {path.parent}")
    if path.is_dir():
        raise BadInput("a folder stands where the file should go", file=path, hint="name a file")
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield beside
        beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)
