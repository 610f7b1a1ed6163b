"""Windows and macOS, as far as they can be simulated: no POSIX module is needed, and processes are spawned."""

import ast
import os
import signal
import sys
import types
from pathlib import Path

import pytest

from recon.runtime.executors import open_executor
from recon.runtime.interrupts import handle_interrupts
from scanner.files import lock_file
from scanner.hdf5 import check_ends

ROOT = Path(__file__).parent.parent.parent
POSIX_MODULES = {"fcntl", "grp", "posix", "pwd", "resource", "termios", "pty"}


def posix_imports(path: Path) -> list[str]:
    """Imports of modules that Windows lacks, outside a ``try``."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    guarded = {id(inner) for node in ast.walk(tree) if isinstance(node, ast.Try) for inner in ast.walk(node)}
    imports = [n for n in ast.walk(tree) if isinstance(n, ast.Import | ast.ImportFrom) and id(n) not in guarded]
    names = [alias.name for node in imports for alias in node.names]
    names += [node.module or "" for node in imports if isinstance(node, ast.ImportFrom)]
    return [name for name in names if name.split(".")[0] in POSIX_MODULES]


@pytest.mark.parametrize("package", ["scanner", "phantoms", "estimation", "recon", "lissajous"])
def test_no_module_of_posix_is_imported_without_a_guard(package: str) -> None:
    assert {str(path): names for path in (ROOT / package).rglob("*.py") if (names := posix_imports(path))} == {}


def test_a_file_is_locked_without_fcntl(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []
    windows = types.ModuleType("msvcrt")
    windows.LK_NBLCK = 2  # type: ignore[attr-defined]
    windows.locking = lambda *arguments: calls.append(arguments)  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "fcntl", None)
    monkeypatch.setitem(sys.modules, "msvcrt", windows)
    with (tmp_path / "journal").open("ab+") as file:
        file.write(b"line\n")
        position = file.tell()
        lock_file(file)
        assert file.tell() == position
    assert [call[1:] for call in calls] == [(2, 1)]


def test_a_lock_is_exclusive(tmp_path: Path) -> None:
    pytest.importorskip("fcntl")
    with (tmp_path / "journal").open("ab+") as first, (tmp_path / "journal").open("ab+") as second:
        lock_file(first)
        with pytest.raises(OSError):  # noqa: PT011 (its text depends on the system)
            lock_file(second)


def test_interrupts_need_no_timer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(signal, "setitimer", raising=False)
    monkeypatch.delattr(signal, "SIGALRM", raising=False)
    with handle_interrupts() as stop, pytest.raises(KeyboardInterrupt):
        stop(signal.SIGINT, None)
    assert stop.came


def test_a_file_is_not_checked_in_a_fork_where_there_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "fork", raising=False)
    (tmp_path / "damaged.h5").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(64))
    check_ends(tmp_path / "damaged.h5")


def test_processes_are_spawned_on_every_system() -> None:
    with open_executor(workers=1) as executor:
        assert executor._mp_context.get_start_method() == "spawn"  # type: ignore[attr-defined]
