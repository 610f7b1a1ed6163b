"""The command in a process of its own: what it took. Linux alone tells a process's own peak memory.

python -m benchmarks.process reconstruct scan.h5 -o out
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path


def peak_mb() -> float:
    """Peak resident memory of this process alone: what getrusage tells has the process in it that started this one."""
    (peak,) = (line.split()[1] for line in Path("/proc/self/status").read_text().splitlines() if "VmHWM" in line)
    return int(peak) / 1024


def timed(*arguments: str) -> dict[str, float]:
    """Seconds on the clock, processor seconds and peak memory of the command with these arguments."""
    began = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.process", *arguments], check=True, stdout=subprocess.PIPE, text=True
    )
    seconds = time.perf_counter() - began
    return {"seconds": seconds, **json.loads(done.stdout.splitlines()[-1])}


def main() -> int:
    from recon.cli import main as command

    code = command(sys.argv[1:])
    print(json.dumps({"cpu_s": time.process_time(), "peak_mb": peak_mb()}))
    return code


if __name__ == "__main__":
    sys.exit(main())
