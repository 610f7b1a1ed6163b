"""``make papers``: run every comparison, or those named, and write ``results.json`` and ``figures/``."""

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
    """Run the named parts and put theirs into ``results.json``; all of them, which starts it anew, by default."""
    unknown = set(names) - set(PARTS)
    if unknown:
        raise BadInput(f"no part is named {', '.join(sorted(unknown))}", hint=f"there are {', '.join(PARTS)}")
    path = HERE / "results.json"
    results: Results = json.loads(path.read_text()) if names and path.exists() else {}
    for name in names or PARTS:
        begun = time.perf_counter()
        found: Results = import_module(f"benchmarks.papers.{name}").results()
        results |= found
        with replacing(path) as beside:
            beside.write_text(json.dumps(dict(sorted(results.items())), indent=1) + "\n")
        print(f"{name}: {len(found)} figures in {time.perf_counter() - begun:.0f} s", file=sys.stderr)
        for key, entry in found.items():
            paper = "" if entry["paper"] is None else f"   paper {entry['paper']:.5g}"
            print(f"  {key:62s} {entry['ours']:12.5g}{paper}")


if __name__ == "__main__":
    main(sys.argv[1:])
