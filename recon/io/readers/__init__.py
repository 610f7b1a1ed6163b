"""Instruments' file formats, one module each, which states its ``READER``; ``read`` chooses among them.

A reader reports what a file states and adds nothing: units, clocks and channel names that the file does not state come
from the user's mapping. Users add formats with :func:`register`.
"""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache
from pathlib import Path

from recon.io.readers.contents import Contents
from recon.io.readers.reader import Reader
from scanner.errors import BadInput
from scanner.user_files import load_objects

__all__ = ["Contents", "Reader", "detect_format", "read", "readers", "register", "registered"]

HELPER_MODULES = ("column_names", "contents", "reader", "table_start", "text_table")
"""Modules of this package that are not a format."""

LONGEST_BEGINNING = 32
"""Bytes of a file that are read to recognise its format; no reader may state a longer beginning."""

_REGISTERED: dict[Path, list[Reader]] = {}
"""Readers of users' files, by file."""


def readers() -> dict[str, Reader]:
    """Every reader by the name of its format; a user's reader replaces one of this package with the same name."""
    users = [reader for group in _REGISTERED.values() for reader in group]
    named = {reader.name: reader for reader in (*_package_readers(), *users)}
    return dict(sorted(named.items()))


def register(path: str | Path) -> None:
    """Add the readers that a user's Python file defines.

    Raises:
        BadInput: no such file, it fails to run, or it defines no ``Reader``.
    """
    file = Path(path).resolve()
    _REGISTERED[file] = load_objects(file, Reader, "--readers")


def registered() -> tuple[Path, ...]:
    """The users' files that were registered."""
    return tuple(_REGISTERED)


def detect_format(path: Path) -> str:
    """Name of a file's format, recognised by how the file begins, else by its name.

    Raises:
        BadInput: the file cannot be read, or no reader recognises it.
    """
    try:
        with path.open("rb") as file:
            beginning = file.read(LONGEST_BEGINNING)
    except OSError as error:
        raise BadInput(f"cannot be read: {error.strerror}", file=path, hint="name the instrument's file") from None
    if not beginning:
        raise BadInput("the file is empty", file=path, hint="copy it again")
    _check_not_packed(path, beginning)
    users = [reader for group in _REGISTERED.values() for reader in group]
    candidates = [*users, *_package_readers()]
    for reader in candidates:
        if beginning.startswith(reader.beginnings):
            return reader.name
    for reader in candidates:
        if path.suffix.lower() in reader.suffixes:
            return reader.name
    hint = f"name it in the mapping or by --format: {', '.join(readers())}"
    raise BadInput("is of no format that is known by its beginning or its name", file=path, hint=hint)


PACKED = {
    b"\x1f\x8b": ("is compressed (gzip)", "unpack it first"),
    b"BZh": ("is compressed (bzip2)", "unpack it first"),
    b"\xfd7zXZ": ("is compressed (xz)", "unpack it first"),
    b"7z\xbc\xaf": ("is an archive (7z)", "unpack it first"),
    b"\xd0\xcf\x11\xe0": ("is a document of Microsoft Office", "save the table as CSV"),
    b"%PDF": ("is a PDF document", "export the samples from the instrument"),
}
"""What files are that hold no samples themselves, and what to do, by their beginning."""

SPREADSHEETS = (".xlsx", ".xlsm", ".ods")
"""Endings of spreadsheets, which begin as NumPy archives do."""


def _check_not_packed(path: Path, beginning: bytes) -> None:
    """Raise BadInput for compressed files and documents."""
    if path.suffix.lower() in SPREADSHEETS:
        raise BadInput("is a spreadsheet", file=path, hint="save the table as CSV")
    for start, (what, hint) in PACKED.items():
        if beginning.startswith(start):
            raise BadInput(what, file=path, hint=hint)


def read(path: Path, name: str | None = None) -> Contents:
    """Contents of a file.

    Args:
        path: the file.
        name: of its format; None detects it.

    Raises:
        BadInput: an unknown format, or a file that the reader refuses.
    """
    name = name or detect_format(path)
    if name not in readers():
        known = ", ".join(readers())
        raise BadInput(f"format {name!r} is unknown", file=path, channel="format", hint=f"known formats: {known}")
    contents = readers()[name].read(path)
    if not contents.variables:
        contents.close()
        raise BadInput(f"is read as {contents.kind}, with nothing in it", file=path, hint="record or export it again")
    return contents


@cache
def _package_readers() -> tuple[Reader, ...]:
    modules = sorted(module.name for module in pkgutil.iter_modules(__path__) if module.name not in HELPER_MODULES)
    return tuple(importlib.import_module(f"{__name__}.{name}").READER for name in modules)
