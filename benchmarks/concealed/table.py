"""From runs and opened keys to rates, and from rates to a page."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from statistics import median
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.concealed.effects import CATALOGUE

if TYPE_CHECKING:
    from benchmarks.concealed.score import Run

CLEAR = 4.5
"""Distance to the nearest look-alike, and own size, above which a single name is asked for [sigma]."""
CONSISTENT, FAILED = "consistent", "failed"
ALSO_CALLED = {
    "dk": "alpha", "db": "beta", "drift": "g", "scale": "s", "shape": "a", "carrier": "half_square", "amplitude": "g",
    "feedthrough": "g",
}  # fmt: skip
"""Names that a diagnosis may give to a key's parameter."""
SIGN_FREE = {"k2", "theta_c"}
"""An even capacitance cannot know these signs; an angle channel can."""

STAGES = {effect.name: effect.stage for effect in CATALOGUE}

GOALS = {
    "false alarm, white noise": "≤ 2 %",
    "false alarm, coloured noise": "≤ 2 %",
    "right name, one effect, clear": "≥ 95 %",
    "named class holds the truth, visible": "≥ 97 %",
    "right stage, visible": "≥ 99 %",
    "both named, two effects, clear": "≥ 80 %",
    "unknown and right stage, unlisted, clear": "≥ 90 %",
    "95 % intervals that hold the truth": "92 to 98 %",
}
"""By rate."""

SECONDS = {
    "ring": ("ringdowns, 80 ms", "≤ 60"),
    "drive": ("driven, 24 ms", "≤ 60"),
    "tf": ("transfer functions, 1.2 s", ""),
}
"""By family what it is called, and its goal."""

ABOUT = f"""Recordings made by a truth generator that shares nothing with the diagnosis, each diagnosed by the command
line, then held against its sealed key. An effect is visible from {CLEAR} σ on behind the nominal values, and clear if
its nearest look-alike leaves as much of it. Every third is in coloured noise.
"""

Answer = Callable[["Run"], bool]


def findings(run: Run) -> list[dict[str, Any]]:
    """In order of weight, none for a consistent or a failed run."""
    return run.diagnosis["findings"] if run.diagnosis and run.diagnosis["verdict"] == "mismatch" else []


def first_name(run: Run) -> str:
    """The first finding's effect, or what stood in its place."""
    if run.diagnosis is None:
        return FAILED
    found = findings(run)
    return found[0]["effect"] if found else run.diagnosis["verdict"]


def visible(run: Run) -> bool:
    """Whether every hidden effect is large enough to be seen at all; keys without distances are taken to be so."""
    return all(effect.get("sigma", np.inf) >= CLEAR for effect in run.key["effects"])


def clear(run: Run) -> bool:
    """Whether every hidden effect is far enough from its look-alikes to be named singly."""
    return visible(run) and all(effect.get("distance", np.inf) >= CLEAR for effect in run.key["effects"])


def stage_clear(run: Run) -> bool:
    """Whether of every hidden effect's nearest look-alikes those of another stage leave as much as a name needs."""
    return visible(run) and all(
        distance >= CLEAR
        for effect in run.key["effects"]
        for name, distance in effect.get("rivals", {}).items()
        if STAGES[name] != effect["stage"]
    )


def right_name(run: Run) -> bool:
    return first_name(run) == run.key["effects"][0]["effect"]


def right_class(run: Run) -> bool:
    """The first finding names the truth, or counts it among its rivals."""
    found = findings(run)
    named = {found[0]["effect"], *(rival["effect"] for rival in found[0].get("rivals", []))} if found else set()
    return run.key["effects"][0]["effect"] in named


def right_stage(run: Run) -> bool:
    found = findings(run)
    return bool(found) and found[0]["stage"] == run.key["effects"][0]["stage"]


def both_named(run: Run) -> bool:
    return {effect["effect"] for effect in run.key["effects"]} <= {finding["effect"] for finding in findings(run)}


def unknown_in_place(run: Run) -> bool:
    return first_name(run) == "unknown" and right_stage(run)


def false_alarm(run: Run) -> bool:
    return run.diagnosis is None or run.diagnosis["verdict"] != CONSISTENT


def held(run: Run) -> list[bool]:
    """For every parameter of a rightly named effect whether its 95 % interval holds the truth."""
    answers = []
    for effect in run.key["effects"]:
        named = next((finding for finding in findings(run) if finding["effect"] == effect["effect"]), None)
        stated = {p["name"]: p["ci95"] for p in named["parameters"]} if named else {}
        for name, truth in effect["parameters"].items():
            interval = stated.get(name) or stated.get(ALSO_CALLED.get(name, name))
            if interval and None not in interval:
                signs = (1, -1) if name in SIGN_FREE and not run.key.get("angle") else (1,)
                answers.append(any(min(interval) <= sign * truth <= max(interval) for sign in signs))
    return answers


def rate(runs: Iterable[Run], answer: Answer) -> dict[str, Any]:
    """Share of runs of which ``answer`` is true, with Wilson's 95 % interval (J. Am. Stat. Assoc. 22, 209, 1927)."""
    answers = [answer(run) for run in runs]
    return share(sum(answers), len(answers))


def share(k: int, n: int) -> dict[str, Any]:
    if n == 0:
        return {"of": 0, "rate": None, "ci95": None}
    z, p = 1.959964, k / n
    middle, spread = p + z * z / (2 * n), z * np.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    bounds = [float((middle + sign * spread) / (1 + z * z / n)) for sign in (-1, 1)]
    return {"of": n, "rate": p, "ci95": [max(0.0, bounds[0]), min(1.0, bounds[1])]}


def summary(runs: Sequence[Run]) -> dict[str, Any]:
    """All figures of the proof, ready for JSON."""
    kinds = {kind: [run for run in runs if run.key["kind"] == kind] for kind in ("none", "one", "two", "unlisted")}
    one, two, unlisted = kinds["one"], kinds["two"], kinds["unlisted"]
    heldout = [finding["heldout"] for run in one if right_name(run) for finding in findings(run)[:1]]
    answers = [answer for run in one + two for answer in held(run)]
    return {
        "recordings": {kind: len(of_kind) for kind, of_kind in kinds.items()},
        "rates": {
            "false alarm, white noise": rate((r for r in kinds["none"] if not r.key["coloured"]), false_alarm),
            "false alarm, coloured noise": rate((r for r in kinds["none"] if r.key["coloured"]), false_alarm),
            "right name, one effect, clear": rate(filter(clear, one), right_name),
            "right name, one effect, any": rate(one, right_name),
            "named class holds the truth, visible": rate(filter(visible, one), right_class),
            "right stage, visible": rate(filter(visible, one), right_stage),
            "right stage, look-alikes of other stages clear": rate(filter(stage_clear, one), right_stage),
            "both named, two effects, clear": rate(filter(clear, two), both_named),
            "both named, two effects, any": rate(two, both_named),
            "unknown and right stage, unlisted, clear": rate(filter(clear, unlisted), unknown_in_place),
            "unknown and right stage, unlisted, any": rate(unlisted, unknown_in_place),
            "unknown, unlisted, any stage": rate(unlisted, lambda run: first_name(run) == "unknown"),
            "95 % intervals that hold the truth": share(sum(answers), len(answers)),
        },
        "heldout": {
            "before": median(h["before"] for h in heldout) if heldout else None,
            "after": median(h["after"] for h in heldout) if heldout else None,
        },
        "seconds": {family: _seconds([r.seconds for r in runs if r.key["family"] == family]) for family in SECONDS},
        "confusion": _confusion(kinds["none"] + one + unlisted),
        "wrong": [_account(run) for run in runs if not _right(run)],
        "failures": {run.name: run.failure for run in runs if run.failure},
    }


def _seconds(taken: Sequence[float]) -> dict[str, Any]:
    if not taken:
        return {"of": 0}
    return {
        "of": len(taken),
        "median": median(taken),
        "longest": max(taken),
        "over a minute": sum(s > 60 for s in taken),
    }


def markdown(score: dict[str, Any]) -> str:
    """The summary as part of a page."""
    counts = ", ".join(f"{count} {kind}" for kind, count in score["recordings"].items())
    lines = [ABOUT, f"Recordings: {counts}.", "", "| | rate | 95 % interval | of | goal |", "|---|---|---|---|---|"]
    for name, of in score["rates"].items():
        if of["of"]:
            low, high = of["ci95"]
            goal = GOALS.get(name, "")
            lines.append(f"| {name} | {of['rate']:.1%} | {low:.1%} to {high:.1%} | {of['of']} | {goal} |")
    heldout = score["heldout"]
    if heldout["after"] is not None:
        after = f"{heldout['before']:.3g} → {heldout['after']:.3g}"
        lines.append(f"| held-out residual, median (reduced chi-square) | {after} | | | ≤ 1.05 |")
    for family, taken in score["seconds"].items():
        if taken["of"]:
            called, goal = SECONDS[family]
            told = f"{taken['median']:.0f}, {taken['longest']:.0f}; {taken['over a minute']} over 60"
            lines.append(f"| seconds, {called}: median, longest | {told} | | {taken['of']} | {goal} |")
    lines += ["", "| hidden | named first (times) |", "|---|---|"]
    for truth, names in score["confusion"].items():
        lines.append(f"| {truth} | {', '.join(f'{name} ({count})' for name, count in names.items())} |")
    if score["wrong"]:
        lines += ["", "| recording | hidden | distance, nearest | said |", "|---|---|---|---|"]
        lines += [f"| {w['name']} | {w['hidden']} | {w['distance']} | {w['said']} |" for w in score["wrong"]]
    return "\n".join(lines) + "\n"


def _right(run: Run) -> bool:
    answers: dict[str, Answer] = {
        "none": lambda r: not false_alarm(r), "one": right_name, "two": both_named, "unlisted": unknown_in_place,
    }  # fmt: skip
    return answers[run.key["kind"]](run)


def _confusion(runs: Iterable[Run]) -> dict[str, dict[str, int]]:
    counts: dict[str, Counter[str]] = {}
    for run in runs:
        hidden = run.key["effects"][0]["effect"] if run.key["effects"] else "none"
        counts.setdefault(hidden, Counter())[first_name(run)] += 1
    return {hidden: dict(counts[hidden].most_common()) for hidden in sorted(counts)}


def _account(run: Run) -> dict[str, str]:
    """One line on a run that went wrong."""
    effects = run.key["effects"]
    apart = [f"{e['distance']:.1f} {e['nearest']}" for e in effects if "distance" in e]
    said = [f"{finding['effect']} ({finding['stage']})" for finding in findings(run)] or [first_name(run)]
    return {
        "name": run.name,
        "hidden": " + ".join(f"{e['effect']} ({e['stage']})" for e in effects) or "none",
        "distance": ", ".join(apart) or "-",
        "said": ", ".join(said),
    }
