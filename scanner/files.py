"""Reading TOML with errors that name the file, and writing a file so that nobody ever meets half of one."""

from __future__ import annotations

import os
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

from scanner.errors import BadInput

_DEFLATE_MOST = 1032  # bytes out of one byte: https://zlib.net/zlib_tech.html
_HARMLESS = 1 << 26


def check_place(path: Path) -> None:
    """Refuse a file for output where it could not be written; for before the work whose result it is to hold.

    Raises:
        BadInput: the folder of ``path`` does not exist or may not be written into, or ``path`` is a folder.
    """
    if not path.parent.is_dir():
        raise BadInput("the folder to write into does not exist", file=path, hint=f"create {path.parent}")
    if path.is_dir():
        raise BadInput("a folder stands where the file should go", file=path, hint="name a file")
    check_writable(path.parent)


def check_writable(folder: Path) -> None:
    """Refuse a folder in which nothing can be made (BadInput)."""
    try:
        with TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise BadInput(f"cannot be written into: {error.strerror}", file=folder, hint="name another place") from None


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """A path to write to, beside ``path``: it takes ``path``'s place when the block ends and vanishes when it fails.

    Raises:
        BadInput: as :func:`check_place`.
    """
    path = Path(path)
    check_place(path)
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield beside
        beside.replace(path)
    except OSError as error:
        # Where writing failed nothing names the file, or else the hidden one, which tells nobody anything.
        error.filename = str(error.filename or path).replace(str(beside), str(path))
        raise
    finally:
        beside.unlink(missing_ok=True)


def check_claim(claimed: int, stored: int, *, file: object, channel: str | None = None) -> None:
    """Refuse a size [bytes] that what is ``stored`` [bytes] cannot hold, however well it was compressed.

    Raises:
        BadInput: the claim is beyond what deflate can shrink, and large enough to do harm.
    """
    if claimed > max(_HARMLESS, _DEFLATE_MOST * stored):
        hint = "the file is damaged or truncated; copy it again"
        raise BadInput(f"claims {claimed} bytes and stores {stored}", file=file, channel=channel, hint=hint)


def read_toml(path: str | Path) -> dict[str, Any]:
    """The table in a TOML file.

    Raises:
        BadInput: the file cannot be read, or is not TOML.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except OSError as error:
        raise BadInput(f"cannot be read: {error.strerror}", file=path, hint="name a TOML file") from None
    except UnicodeDecodeError:
        raise BadInput("is not text (UTF-8)", file=path, hint="name a TOML file") from None
    return parse_toml(text, path)


def parse_toml(text: str, source: object) -> dict[str, Any]:
    """The table that ``text`` holds; BadInput, naming ``source``, where it is not TOML."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise BadInput(f"is not TOML: {error}", file=source, hint="correct the place it names") from None
    except (ValueError, RecursionError) as error:  # a number of thousands of digits, brackets in brackets
        raise BadInput(f"is not TOML that can be read: {error}", file=source, hint="write it simpler") from None
