"""Run the diagnosis on sealed recordings, open the keys, and count.

    python -m benchmarks.concealed.score RECORDINGS KEYS OUT [--timeout 600] [--workers 2] [--page PAGE]

KEYS is a file of keys, or the folder into which they are being written: what is there by now is scored.

Writes ``OUT/<recording>/`` (what the diagnosis wrote), ``OUT/score.json`` and ``OUT/score.md``, which goes into PAGE as
well. A recording whose diagnosis was run into the same OUT is not run again. Keys with one effect and no distances are
taken as well.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from benchmarks.concealed.table import markdown, summary

KEYS = "keys.json"
BEGIN, END = "<!-- sealed recordings: written by `make concealed` -->\n", "<!-- end of sealed recordings -->"


@dataclass(frozen=True)
class Run:
    """One recording, its opened key and what the diagnosis said.

    Attributes:
        key: in the form of :func:`opened`.
        diagnosis: None where none was written.
        seconds: wall time.
        failure: why there is no diagnosis, else an empty string.
    """

    name: str
    key: dict[str, Any]
    diagnosis: dict[str, Any] | None
    seconds: float
    failure: str = ""


def opened(key: dict[str, Any]) -> dict[str, Any]:
    """A key in one form, whether it came with a list of effects or with one effect and its stage."""
    if "effects" in key:
        return key
    none = key["effect"] == "none"
    only = {"effect": key["effect"], "stage": key["stage"], "listed": True, "parameters": key["parameters"]}
    return key | {"kind": "none" if none else "one", "effects": [] if none else [only]}


def diagnose(recording: Path, out: Path, command: list[str], timeout: float) -> None:
    """One run of the command line; what became of it is left in ``out/run.json``."""
    out.mkdir(parents=True, exist_ok=True)
    started, failure = time.monotonic(), ""
    try:
        done = subprocess.run(
            [*command, "diagnose", str(recording), "-o", str(out), "--json"],
            capture_output=True, text=True, timeout=timeout, check=False,
        )  # fmt: skip
        if done.returncode:
            failure = f"exit {done.returncode}: {done.stderr.strip().splitlines()[-1] if done.stderr.strip() else ''}"
    except subprocess.TimeoutExpired:
        failure = f"more than {timeout:g} s"
    (out / "run.json").write_text(json.dumps({"seconds": time.monotonic() - started, "failure": failure}))


def load(name: str, key: dict[str, Any], out: Path) -> Run:
    """What a run left behind."""
    ran = json.loads((out / "run.json").read_text())
    written = out / "diagnosis.json"
    diagnosis = json.loads(written.read_text()) if written.exists() and not ran["failure"] else None
    failure = ran["failure"] or ("" if diagnosis else "no diagnosis.json")
    return Run(name, opened(key), diagnosis, ran["seconds"], failure)


def keys_of(path: Path) -> dict[str, Any]:
    """Keys by recording, from one file or from a folder of single ones."""
    if path.is_dir():
        return {each.stem: json.loads(each.read_text()) for each in sorted(path.glob("*.json")) if each.name != KEYS}
    keys: dict[str, Any] = json.loads(path.read_text())
    return keys


def put_into(page: Path, text: str) -> None:
    """Write ``text`` between the two marks of a page."""
    before, _, rest = page.read_text().partition(BEGIN)
    _, end, after = rest.partition(END)
    if not end:
        raise SystemExit(f"{page}: holds no {BEGIN.strip()} before {END}")
    page.write_text(f"{before}{BEGIN}\n{text}\n{END}{after}")


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="Diagnose sealed recordings, then open their keys and count.")
    parser.add_argument("recordings", type=Path)
    parser.add_argument("keys", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--timeout", type=float, default=600.0, metavar="SECONDS")
    parser.add_argument("--workers", type=int, default=2, choices=(1, 2))
    parser.add_argument("--command", default=str(Path(sys.executable).with_name("lissajous")))
    parser.add_argument("--page", type=Path)
    options = parser.parse_args(arguments)
    keys = keys_of(options.keys)

    def run(name: str) -> Run:
        out = options.out / name
        if not (out / "run.json").exists():
            diagnose(options.recordings / f"{name}.h5", out, [options.command], options.timeout)
        return load(name, keys[name], out)

    with ThreadPoolExecutor(options.workers) as pool:
        runs = list(tqdm(pool.map(run, keys), total=len(keys), desc="diagnosed", disable=None))
    score = summary(runs)
    (options.out / "score.json").write_text(json.dumps(score, indent=1))
    (options.out / "score.md").write_text(markdown(score))
    if options.page:
        put_into(options.page, markdown(score))
    return 0


if __name__ == "__main__":
    sys.exit(main())
