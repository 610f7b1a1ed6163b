"""Reading TOML with errors that name the file, and writing files that appear only when they are complete."""

from __future__ import annotations

import os
import re
import threading
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any

from scanner.errors import BadInput

_MAX_DEFLATE_RATIO = 1032
"""Largest compression ratio of deflate (https://zlib.net/zlib_tech.html)."""

WINDOWS_LOCK_OFFSET = 1 << 30
"""Place of the byte that is locked on Windows: 1 GB, behind the end of any file that is locked here."""

_MIN_CHECKED_BYTES = 1 << 26
"""Sizes below 64 MB are not checked: even if they are wrong, any computer can allocate them."""


def check_parent(path: Path) -> None:
    """Check that the folder of an output exists.

    Raises:
        BadInput: it does not exist, or is a file.
    """
    if path.parent.is_file():
        raise BadInput(f"{path.parent} is a file where a folder should be", file=path, hint="name another with -o")
    if not path.parent.is_dir():
        raise BadInput("the folder to write into does not exist", file=path, hint=f"create {path.parent}")


def check_place(path: Path) -> None:
    """Check that an output file can be written, before the work whose result it will hold.

    Raises:
        BadInput: the folder of ``path`` does not exist, is a file or may not be written into, or ``path`` is a folder.
    """
    check_parent(path)
    if path.is_dir():
        raise BadInput("is a folder, not a file", file=path, hint="name a file")
    check_writable(path.parent)


def check_no_input(output: Path, *inputs: Path) -> None:
    """Check that an output file is none of the files that the command reads, which it would destroy.

    Raises:
        BadInput: it is.
    """
    if output.exists() and any(each.exists() and output.samefile(each) for each in inputs):
        raise BadInput("is read by this command and would be overwritten", file=output, hint="name another with -o")


def check_writable(folder: Path) -> None:
    """Check that files can be made in a folder.

    Raises:
        BadInput: they cannot.
    """
    try:
        with TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise BadInput(f"cannot be written into: {error.strerror}", file=folder, hint="name another place") from None


IS_REPLACING = threading.Event()
"""Set while a finished file takes its place, which cannot be undone: an interrupt has to wait for the end."""

HAS_REPLACED = threading.Event()
"""Set as soon as a finished file takes its place, usually the last work of a command."""


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path in the folder of ``path`` to write to. It replaces ``path`` when the block ends and is
    deleted when it fails.

    Raises:
        BadInput: as :func:`check_place`.
    """
    path = Path(path)
    check_place(path)
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield beside
        IS_REPLACING.set()
        HAS_REPLACED.set()
        beside.replace(path)
    except OSError as error:
        # The error names no file, or the temporary one, which the user does not know.
        error.filename = str(error.filename or path).replace(str(beside), str(path))
        raise
    finally:
        beside.unlink(missing_ok=True)
        IS_REPLACING.clear()


def check_claim(claimed: int, stored: int, *, file: object, channel: str | None = None) -> None:
    """Check a size that a file states against what its stored bytes can hold, however well they are compressed.

    Args:
        claimed: stated size [bytes].
        stored: bytes in the file.
        file, channel: for messages.

    Raises:
        BadInput: the stated size is beyond the compression of deflate, and large enough to exhaust the memory.
    """
    if claimed > max(_MIN_CHECKED_BYTES, _MAX_DEFLATE_RATIO * stored):
        hint = "the file is damaged or truncated; copy it again"
        raise BadInput(f"claims {claimed} bytes and stores {stored}", file=file, channel=channel, hint=hint)


def read_toml(path: str | Path) -> dict[str, Any]:
    """Return the table in a TOML file.

    Raises:
        BadInput: the file cannot be read, or is not TOML.
    """
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except OSError as error:
        raise BadInput(f"cannot be read: {error.strerror}", file=path, hint="name a TOML file") from None
    except UnicodeDecodeError:
        raise BadInput("is not text (UTF-8)", file=path, hint="name a TOML file") from None
    return parse_toml(text, path)


def parse_toml(text: str, source: object) -> dict[str, Any]:
    """Return the table in a TOML text.

    Raises:
        BadInput: it is not TOML; the message names ``source``.
    """
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise BadInput(f"is not TOML: {error}", file=source, hint=_toml_hint(text, str(error))) from None
    except (ValueError, RecursionError) as error:  # thousands of digits, or too deeply nested brackets
        raise BadInput(f"is not TOML that can be read: {error}", file=source, hint="write it simpler") from None


def _toml_hint(text: str, message: str) -> str:
    """What to correct in a text that is not TOML; the line that the message names is quoted."""
    named = re.search(r"at line (\d+)", message)
    line = text.splitlines()[int(named[1]) - 1].strip() if named else ""
    if re.fullmatch(r"\w+ *= *[+-]?\d+,\d+ *(#.*)?", line):
        return f"write the number of {line!r} with a point"
    return f"correct the line {line!r}" if line else "correct the line that it names"


def lock_file(file: IO[bytes]) -> None:
    """Lock an open file against other processes until it is closed. The lock is advisory on POSIX.

    Raises:
        OSError: another process holds the lock.
    """
    try:
        import fcntl
    except ModuleNotFoundError:  # Windows
        import msvcrt

        position = file.tell()
        file.seek(WINDOWS_LOCK_OFFSET)  # bytes behind the content: a locked byte cannot be read by others
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined, unused-ignore]
        file.seek(position)
    else:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
