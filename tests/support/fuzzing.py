"""Random damage to files, and a child process with limited memory and time in which a reader is tried."""

from __future__ import annotations

import os
import resource
import signal
import struct
import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

MAX_FILE_BYTES = 3 << 30
MAX_ADDED_MEMORY_BYTES = 2 << 30
"""Memory of a child process beyond that of the test process, which grows with the tests that ran before."""
MAX_TIME_S = 20

HUGE = [0, 1, 0x7F, 0xFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 10**9, 10**12, 2**62, 2**63 - 1, 2**64 - 1]
WORDS = [b"nan", b"inf", b"-1", b"0", b"1e999", b"1e-320", b"-5e6", b"\x00", b"\xff\xfe"]
WORDS += [b"9" * 5000, b",,,", b"\t", b"[[["]


def cut(data: bytes, rng: np.random.Generator) -> bytes:
    """``data`` without its end."""
    return data[: rng.integers(0, len(data) + 1)]


def flip(data: bytes, rng: np.random.Generator) -> bytes:
    """``data`` with some bits flipped, most of them in the header."""
    out = bytearray(data)
    for _ in range(rng.integers(1, 9)):
        at = rng.integers(0, min(len(out), 2048) if rng.random() < 0.6 else len(out))
        out[at] ^= 1 << rng.integers(0, 8)
    return bytes(out)


def claim(data: bytes, rng: np.random.Generator) -> bytes:
    """``data`` with a number replaced, for example a size by one 10^9 times larger."""
    form = rng.choice(["<H", "<I", "<Q", ">I", ">Q", "<d"])
    size = struct.calcsize(form)
    at = int(rng.integers(0, max(min(len(data), 4096) if rng.random() < 0.7 else len(data), size + 1) - size))
    if form == "<d":
        number = struct.pack(form, rng.choice([np.nan, np.inf, -1.0, 0.0, 1e300, 1e-320]))
    else:
        number = struct.pack(form, HUGE[rng.integers(len(HUGE))] % (1 << (8 * size)))
    return data[:at] + number + data[at + size :]


def repeat(data: bytes, rng: np.random.Generator) -> bytes:
    """``data`` with a segment repeated, removed, or set to zero."""
    low, high = sorted(rng.integers(0, len(data) + 1, 2))
    high = min(high, low + 4096)
    return data[:low] + [b"", 2 * data[low:high], bytes(high - low)][rng.integers(3)] + data[high:]


def reword(data: bytes, rng: np.random.Generator) -> bytes:
    """``data`` with some bytes replaced by an unusual word such as nan or 1e999."""
    at = int(rng.integers(0, min(len(data), 600) if rng.random() < 0.7 else len(data)))
    return data[:at] + WORDS[rng.integers(len(WORDS))] + data[at + int(rng.integers(0, 12)) :]


DAMAGES = [cut, flip, claim, repeat, reword]


def damaged(data: bytes, seed: int) -> tuple[bytes, str]:
    """``data`` with one or two kinds of damage, and the names of these kinds."""
    rng = np.random.default_rng(seed)
    names = []
    for _ in range(rng.integers(1, 3)):
        damage = DAMAGES[rng.integers(len(DAMAGES))]
        data = damage(data, rng) if data else data
        names.append(damage.__name__)
    return data, "+".join(names)


@dataclass(frozen=True)
class Outcome:
    """The exit code of a child process, or minus the signal that ended it, and its output on stderr."""

    code: int
    stderr: str

    def is_clean(self) -> bool:
        """Whether the process succeeded or refused its input in one line."""
        if self.code == 0:
            return True
        return self.code == 2 and self.stderr.count("\n") == 1 and "Traceback" not in self.stderr


def data_size() -> int:
    """Size of this process's data segments [bytes], which is what RLIMIT_DATA bounds."""
    status = Path("/proc/self/status").read_text()
    return 1024 * int(next(line.split()[1] for line in status.splitlines() if line.startswith("VmData")))


def run_in_child(
    act: Callable[[], int], log: Path, meanwhile: Callable[[int], None] = lambda pid: None, seconds: int = MAX_TIME_S
) -> Outcome:
    """Run ``act`` in a child process and return its outcome. ``meanwhile`` is called with the process id."""
    sys.stdout.flush()
    log.write_text("")  # a child that is killed at once does not create it
    child = os.fork()
    if not child:
        code = 70
        try:
            signal.alarm(seconds)
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
            memory = data_size() + MAX_ADDED_MEMORY_BYTES
            resource.setrlimit(resource.RLIMIT_DATA, (memory, memory))
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            resource.setrlimit(resource.RLIMIT_FSIZE, (MAX_FILE_BYTES, MAX_FILE_BYTES))
            out = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(out, 2)
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            sys.stderr = os.fdopen(2, "w", errors="backslashreplace", closefd=False)
            sys.stdout = os.fdopen(1, "w", errors="backslashreplace", closefd=False)
            code = act()
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stderr.flush()
            os._exit(code)
    meanwhile(child)
    _, status = os.waitpid(child, 0)
    return Outcome(os.waitstatus_to_exitcode(status), log.read_text(errors="replace"))
