"""The handed-over cases: every recording diagnosed, every answer held against the key.

    python -m benchmarks.shared_cases FOLDER [CASE ...]

FOLDER holds ``case-NN.h5`` and ``keys.json``. The diagnosis sees the recording only; the key is opened when it is done.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

from estimation.mismatch.diagnosis import diagnose
from scanner.recording import Recording


def judged(content: dict[str, Any], key: dict[str, Any]) -> str:
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
    folder, wanted = Path(arguments[0]), arguments[1:]
    keys = json.loads((folder / "keys.json").read_text(encoding="utf-8"))
    tally: dict[str, int] = {}
    print("| case | truth | answer | stage | probability | held-out χ² | s | |\n|---|---|---|---|---|---|---|---|")
    for name, key in keys.items():
        if wanted and name not in wanted:
            continue
        with Recording.open(folder / f"{name}.h5") as recording:
            began = time.perf_counter()
            content = diagnose([recording]).to_json()
            seconds = time.perf_counter() - began
        result = judged(content, key)
        tally[result] = tally.get(result, 0) + 1
        answers = " + ".join(finding["effect"] for finding in content["findings"]) or "consistent"
        first = content["findings"][0] if content["findings"] else None
        shown = (
            (
                first["stage"],
                f"{first['probability']:.3f}",
                f"{first['heldout']['before']:.3g} → {first['heldout']['after']:.3f}",
            )
            if first
            else ("", "", "")
        )
        row = [name, key["effect"], answers, *shown, f"{seconds:.0f}", result]
        print("| " + " | ".join(row) + " |", flush=True)
    print(", ".join(f"{count} {result}" for result, count in sorted(tally.items())))


if __name__ == "__main__":
    main(sys.argv[1:])
