"""Run time and peak memory of the command in a separate process. Needs Linux, whose /proc states the peak memory.

python -m benchmarks.process reconstruct scan.h5 -o out
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path


def read_peak_memory_mb() -> float:
    """Peak resident memory of this process [MB]; ``getrusage`` would include the process that started this one."""
    (peak,) = (line.split()[1] for line in Path("/proc/self/status").read_text().splitlines() if "VmHWM" in line)
    return int(peak) / 1024


def time_command(*arguments: str) -> dict[str, float]:
    """Wall-clock seconds, processor seconds and peak memory [MB] of the command with these arguments."""
    start = time.perf_counter()
    process = subprocess.run(
        [sys.executable, "-m", "benchmarks.process", *arguments], check=True, stdout=subprocess.PIPE, text=True
    )
    seconds = time.perf_counter() - start
    return {"seconds": seconds, **json.loads(process.stdout.splitlines()[-1])}


def main() -> int:
    from recon.cli import main as command

    code = command(sys.argv[1:])
    print(json.dumps({"cpu_s": time.process_time(), "peak_mb": read_peak_memory_mb()}))
    return code


if __name__ == "__main__":
    sys.exit(main())
