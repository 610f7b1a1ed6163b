"""What a file reader states of itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from recon.io.readers.contents import Contents


@dataclass(frozen=True)
class Reader:
    """A file format and the function that reads it.

    Attributes:
        name: of the format, for ``--format`` and the mapping's key ``format``.
        read: returns the contents of a file; raises BadInput if the file is damaged or not of this format.
        beginnings: bytes with which files of this format begin. They take precedence over the file's name.
        suffixes: endings of file names, in lower case with the dot.
    """

    name: str
    read: Callable[[Path], Contents]
    beginnings: tuple[bytes, ...] = ()
    suffixes: tuple[str, ...] = ()
