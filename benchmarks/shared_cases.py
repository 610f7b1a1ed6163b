"""Diagnose a folder of recordings with keys and compare every answer with its key.

    python -m benchmarks.shared_cases FOLDER [CASE ...]

FOLDER holds ``case-NN.h5`` and ``keys.json``. The diagnosis reads the recording only.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

from estimation.diagnosis.diagnose import diagnose
from scanner.recording import Recording


def grade_answer(content: dict[str, Any], key: dict[str, Any]) -> str:
    """``right``, ``class`` (the truth is among the first finding's rivals), or what is wrong."""
    findings = content["findings"]
    if key["effect"] == "none":
        return "right" if content["verdict"] == "consistent" else "false alarm"
    if not findings:
        return "missed"
    first = findings[0]
    extra = f", {len(findings) - 1} too many" if len(findings) > 1 else ""
    if first["effect"] == key["effect"]:
        return "right" + extra
    if key["effect"] in [rival["effect"] for rival in first["rivals"]]:
        return "class" + extra
    return ("stage" if first["stage"] == key["stage"] else "wrong") + extra


def main(arguments: list[str]) -> None:
    folder, selected = Path(arguments[0]), arguments[1:]
    keys = json.loads((folder / "keys.json").read_text(encoding="utf-8"))
    counts: dict[str, int] = {}
    print("| case | truth | answer | stage | probability | held-out χ² | s | |\n|---|---|---|---|---|---|---|---|")
    for name, key in keys.items():
        if selected and name not in selected:
            continue
        with Recording.open(folder / f"{name}.h5") as recording:
            start = time.perf_counter()
            content = diagnose([recording]).to_json()
            seconds = time.perf_counter() - start
        result = grade_answer(content, key)
        counts[result] = counts.get(result, 0) + 1
        answers = " + ".join(finding["effect"] for finding in content["findings"]) or "consistent"
        first = content["findings"][0] if content["findings"] else None
        cells = ["", "", ""]
        if first:
            chi2 = first["heldout"]
            cells = [first["stage"], f"{first['probability']:.3f}", f"{chi2['before']:.3g} → {chi2['after']:.3f}"]
        row = [name, key["effect"], answers, *cells, f"{seconds:.0f}", result]
        print("| " + " | ".join(row) + " |", flush=True)
    print(", ".join(f"{count} {result}" for result, count in sorted(counts.items())))


if __name__ == "__main__":
    main(sys.argv[1:])
