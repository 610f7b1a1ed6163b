"""Uses of the program from an empty folder, by the commands of the documentation: phase error and picture error.

    python -m benchmarks.first_pictures FOLDER [--first SEED] [--only NAME ...]

Each use is a function of ``benchmarks.first_inputs`` that writes an instrument's file without any truth and returns the
commands that its page states. They run as a user would run them; the truth, which stays in this process, is compared
with what they wrote. The picture error is that of the picture over that of the picture from the true angles, both
against the noiseless scene.
"""

from __future__ import annotations

import argparse
import shlex
import subprocess
import sys
import time
from pathlib import Path

from benchmarks.first_inputs import USES
from benchmarks.first_scores import load_axes, load_picture, score_scan

KILL_AFTER_S = 25.0
"""Time after which the first run of a command that is to be interrupted is killed [s]; part of its work is done."""


def run(command: str, folder: Path) -> None:
    """Run one command line of ``lissajous`` in ``folder``; one that begins with ``interrupted`` is killed.

    Raises:
        RuntimeError: it fails; the message is the command and its last line.
    """
    interrupted = command.startswith("interrupted ")
    words = shlex.split(command.removeprefix("interrupted "))
    arguments = [sys.executable, *(words[1:] if words[0] == "python" else ["-m", "recon", *words])]
    if interrupted:
        with subprocess.Popen(arguments, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
            time.sleep(KILL_AFTER_S)
            process.kill()
        return
    done = subprocess.run(arguments, cwd=folder, capture_output=True, text=True)
    with (folder / "commands.log").open("a") as log:
        log.write(f"$ {command}\n{done.stdout}{done.stderr}")
    if done.returncode:
        raise RuntimeError(f"{command}: {(done.stderr.strip() or done.stdout.strip()).splitlines()[-1]}")


def measure(name: str, folder: Path, seed: int) -> list[str]:
    """One row of the table."""
    folder.mkdir(parents=True)
    use = USES[name](folder, seed)
    begin = time.monotonic()
    for command in use.commands:
        run(command, folder)
    seconds = time.monotonic() - begin
    commands = [each for each in use.commands if not each.startswith("interrupted")]
    row = [name, str(len(commands)), f"{seconds:.0f}"]
    if use.score is not None:
        return [*row, *use.score(folder)]
    out = folder / "out"
    cells = score_scan(use, load_axes(out / "motion.h5", use), *load_picture(out))
    return [*row, *cells, use.check(folder) if use.check else ""]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--first", type=int, default=0, metavar="SEED")
    parser.add_argument("--only", nargs="+", choices=USES, default=list(USES))
    args = parser.parse_args()
    head = ["use", "commands", "seconds", "phase error rms x, y", "picture error ratio", "further"]
    print("| " + " | ".join(head) + " |\n|" + "---|" * len(head))
    for k, name in enumerate(USES):
        if name in args.only:
            print("| " + " | ".join(measure(name, args.folder / name, args.first + k)) + " |", flush=True)


if __name__ == "__main__":
    main()
