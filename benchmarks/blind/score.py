"""Diagnose blind recordings and compare the answers with the keys.

    python -m benchmarks.blind.score RECORDINGS KEYS OUT [--timeout 600] [--workers 2] [--page PAGE]

KEYS is a file of keys, or the folder that the generator writes them into; then the recordings that exist are scored.

Writes ``OUT/<recording>/`` (the output of the diagnosis), ``OUT/score.json`` and ``OUT/score.md``; the latter also goes
into PAGE. Where the folder of KEYS has a folder ``unused``, both devices also predict the other recording of the
scanner open loop. Where it has ``angles``, imaging scans are reconstructed with both devices. A recording with an
earlier diagnosis in OUT is not diagnosed again. Keys with a single effect and no distances are read too.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from tqdm import tqdm

from benchmarks.blind.by_family import family_table, summarise_families
from benchmarks.blind.imaging_score import reconstruct_with_both
from benchmarks.blind.outcome import Outcome, normalise_key
from benchmarks.blind.table import markdown, summary

KEYS = "keys.json"
BEGIN, END = "<!-- blind recordings: written by `make blind` -->\n", "<!-- end of blind recordings -->"


def run_diagnosis(recording: Path, out: Path, command: list[str], timeout: float) -> None:
    """Diagnose one recording by the command line; time and failure go to ``out/run.json``."""
    out.mkdir(parents=True, exist_ok=True)
    started, failure = time.monotonic(), ""
    try:
        process = subprocess.run(
            [*command, "diagnose", str(recording), "-o", str(out), "--json"],
            capture_output=True, text=True, timeout=timeout, check=False,
        )  # fmt: skip
        if process.returncode:
            last_line = process.stderr.strip().splitlines()[-1:]
            failure = f"exit {process.returncode}: {''.join(last_line)}"
    except subprocess.TimeoutExpired:
        failure = f"more than {timeout:g} s"
    (out / "run.json").write_text(json.dumps({"seconds": time.monotonic() - started, "failure": failure}))


def predict_unused(unused: Path, out: Path, command: list[str], timeout: float) -> None:
    """Predict another recording of the scanner with both devices; the errors go to ``out/open_loop.json``."""
    errors: dict[str, dict[str, float]] = {}
    for name, device in (("nominal", []), ("improved", ["--device", str(out / "device.toml")])):
        arguments = [*command, "predict", str(unused), "-o", str(out / f"predicted-{name}"), *device, "--json"]
        try:
            process = subprocess.run(arguments, capture_output=True, text=True, timeout=timeout, check=False)
        except subprocess.TimeoutExpired:
            continue
        shutil.rmtree(out / f"predicted-{name}", ignore_errors=True)
        if process.returncode == 0:
            channels = json.loads(process.stdout)["channels"]
            errors[name] = {channel: c["rmse"] for channel, c in channels.items() if channel.startswith("sense")}
    (out / "open_loop.json").write_text(json.dumps(errors))


def load_outcome(name: str, key: dict[str, Any], out: Path) -> Outcome:
    """The outcome of an earlier :func:`run_diagnosis`."""
    run = json.loads((out / "run.json").read_text())
    written = out / "diagnosis.json"
    diagnosis = json.loads(written.read_text()) if written.exists() and not run["failure"] else None
    failure = run["failure"] or ("" if diagnosis else "no diagnosis.json")
    open_loop, imaging = (_read_if_there(out / f"{file}.json") for file in ("open_loop", "imaging"))
    return Outcome(name, normalise_key(key), diagnosis, run["seconds"], failure, open_loop, imaging)


def _read_if_there(path: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
    return content


def read_keys(path: Path) -> dict[str, Any]:
    """Keys by recording, from one file or from a folder of single files."""
    if path.is_dir():
        return {file.stem: json.loads(file.read_text()) for file in sorted(path.glob("*.json")) if file.name != KEYS}
    keys: dict[str, Any] = json.loads(path.read_text())
    return keys


def replace_section(page: Path, text: str) -> None:
    """Write ``text`` between the two marks of a page."""
    before, _, rest = page.read_text().partition(BEGIN)
    _, end, after = rest.partition(END)
    if not end:
        raise SystemExit(f"{page}: holds no {BEGIN.strip()} before {END}")
    page.write_text(f"{before}{BEGIN}\n{text}\n{END}{after}")


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="Diagnose blind recordings and compare with their keys.")
    parser.add_argument("recordings", type=Path)
    parser.add_argument("keys", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--timeout", type=float, default=600.0, metavar="SECONDS")
    parser.add_argument("--workers", type=int, default=2, choices=(1, 2))
    parser.add_argument("--command", default=str(Path(sys.executable).with_name("lissajous")))
    parser.add_argument("--page", type=Path)
    options = parser.parse_args(arguments)
    keys = read_keys(options.keys)
    folder = options.keys if options.keys.is_dir() else options.keys.parent

    def outcome_of(name: str) -> Outcome:
        out = options.out / name
        if not (out / "run.json").exists():
            run_diagnosis(options.recordings / f"{name}.h5", out, [options.command], options.timeout)
        unused = folder / "unused" / f"{name}.h5"
        if unused.exists() and (out / "device.toml").exists() and not (out / "open_loop.json").exists():
            predict_unused(unused, out, [options.command], options.timeout)
        angles = folder / "angles" / f"{name}.npz"
        if angles.exists() and (out / "device.toml").exists() and not (out / "imaging.json").exists():
            recording = options.recordings / f"{name}.h5"
            reconstruct_with_both(recording, angles, out, [options.command], options.timeout)
        return load_outcome(name, keys[name], out)

    with ThreadPoolExecutor(options.workers) as pool:
        outcomes = list(tqdm(pool.map(outcome_of, keys), total=len(keys), desc="diagnosed", disable=None))
    score = summary(outcomes) | {"families": summarise_families(outcomes)}
    text = markdown(score) + "\n" + family_table(score["families"])
    (options.out / "score.json").write_text(json.dumps(score, indent=1))
    (options.out / "score.md").write_text(text)
    if options.page:
        replace_section(options.page, text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
