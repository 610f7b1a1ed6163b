"""``make papers``: run all comparisons, or the named ones, and write ``results.json`` and ``figures/``."""

from __future__ import annotations

import json
import sys
import time
from importlib import import_module

from benchmarks.papers.figures import HERE, Results
from scanner.errors import BadInput
from scanner.files import replacing

PARTS = ("circuit", "parametric", "identification", "table3", "threshold", "hybrid", "sine", "registration")


def main(names: list[str]) -> None:
    """Run the named parts and update their entries in ``results.json``. Without names, run all and replace the file."""
    unknown = set(names) - set(PARTS)
    if unknown:
        raise BadInput(f"no part is named {', '.join(sorted(unknown))}", hint=f"there are {', '.join(PARTS)}")
    path = HERE / "results.json"
    results: Results = json.loads(path.read_text()) if names and path.exists() else {}
    for name in names or PARTS:
        start = time.perf_counter()
        entries: Results = import_module(f"benchmarks.papers.{name}").results()
        results |= entries
        with replacing(path) as part:
            part.write_text(json.dumps(dict(sorted(results.items())), indent=1) + "\n")
        print(f"{name}: {len(entries)} figures in {time.perf_counter() - start:.0f} s", file=sys.stderr)
        for key, entry in entries.items():
            paper = "" if entry["paper"] is None else f"   paper {entry['paper']:.5g}"
            print(f"  {key:62s} {entry['ours']:12.5g}{paper}")


if __name__ == "__main__":
    main(sys.argv[1:])
