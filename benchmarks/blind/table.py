"""From outcomes to rates, and from rates to a table in Markdown."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from statistics import median
from typing import Any

import numpy as np

from benchmarks.blind.effects import CATALOGUE
from benchmarks.blind.outcome import Outcome

CLEAR = 4.5
"""Size, and distance to the nearest confounder, above which a single name is required [sigma]. At 4.5 a wrong choice
between two hypotheses has probability Phi(-2.25) = 1.2 %."""
CONSISTENT, FAILED = "consistent", "failed"
ALSO_CALLED = {
    "dk": "alpha", "db": "beta", "drift": "g", "scale": "s", "shape": "a", "carrier": "half_square", "amplitude": "g",
    "feedthrough": "g",
}  # fmt: skip
"""Name of a parameter in the key -> its name in the catalogue, where they differ."""
SIGN_FREE = {"k2", "theta_c"}
"""Parameters whose sign an even capacitance does not determine; an angle channel does."""

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
"""By name of the rate."""

SECONDS = {
    "ring": ("ringdowns, 80 ms", "≤ 60"),
    "drive": ("driven, 24 ms", "≤ 60"),
    "tf": ("transfer functions, 1.2 s", ""),
}
"""By family its description and goal."""

ABOUT = f"""Recordings of a generator that shares no code with the diagnosis, each diagnosed by the command line and
compared with its key. An effect is visible if it exceeds {CLEAR} σ after a fit of the nominal values, and clear if
it is also {CLEAR} σ from its nearest confounder. Every third recording has coloured noise.
"""

Answer = Callable[[Outcome], bool]


def findings(outcome: Outcome) -> list[dict[str, Any]]:
    """In order of weight; none for a consistent recording or a failure."""
    return outcome.diagnosis["findings"] if outcome.diagnosis and outcome.diagnosis["verdict"] == "mismatch" else []


def same_axis(effect: dict[str, Any], finding: dict[str, Any]) -> bool:
    """Whether a finding concerns the axis of an effect of the key."""
    return bool(effect.get("axis", "x") == finding.get("axis", "x"))


def first_name(outcome: Outcome) -> str:
    """The first finding's effect, else the verdict, or ``failed``."""
    if outcome.diagnosis is None:
        return FAILED
    found = findings(outcome)
    return found[0]["effect"] if found else outcome.diagnosis["verdict"]


def visible(outcome: Outcome) -> bool:
    """Whether every injected effect is large enough to be detected; keys without sizes count as visible."""
    return all(effect.get("sigma", np.inf) >= CLEAR for effect in outcome.key["effects"])


def clear(outcome: Outcome) -> bool:
    """Whether every injected effect is far enough from its confounders to be named singly."""
    return visible(outcome) and all(effect.get("distance", np.inf) >= CLEAR for effect in outcome.key["effects"])


def stage_clear(outcome: Outcome) -> bool:
    """Whether every injected effect is far enough from the confounders of other stages to be placed in its stage."""
    return visible(outcome) and all(
        distance >= CLEAR
        for effect in outcome.key["effects"]
        for name, distance in effect.get("rivals", {}).items()
        if STAGES[name] != effect["stage"]
    )


def right_name(outcome: Outcome) -> bool:
    return first_name(outcome) == outcome.key["effects"][0]["effect"]


def right_class(outcome: Outcome) -> bool:
    """Whether the first finding names the truth or lists it among its rivals."""
    found = findings(outcome)
    named = {found[0]["effect"], *(rival["effect"] for rival in found[0].get("rivals", []))} if found else set()
    return outcome.key["effects"][0]["effect"] in named


def right_stage(outcome: Outcome) -> bool:
    found = findings(outcome)
    return bool(found) and found[0]["stage"] == outcome.key["effects"][0]["stage"]


def both_named(outcome: Outcome) -> bool:
    return {effect["effect"] for effect in outcome.key["effects"]} <= {
        finding["effect"] for finding in findings(outcome)
    }


def unknown_in_place(outcome: Outcome) -> bool:
    return first_name(outcome) == "unknown" and right_stage(outcome)


def false_alarm(outcome: Outcome) -> bool:
    return outcome.diagnosis is None or outcome.diagnosis["verdict"] != CONSISTENT


def intervals_hit(outcome: Outcome) -> list[bool]:
    """For every parameter of a rightly named effect, whether its 95 % interval contains the truth."""
    answers = []
    for effect in outcome.key["effects"]:
        same = [each for each in findings(outcome) if each["effect"] == effect["effect"] and same_axis(effect, each)]
        named = next(iter(same), None)
        stated = {p["name"]: p["ci95"] for p in named["parameters"]} if named else {}
        for name, truth in effect["parameters"].items():
            interval = stated.get(name) or stated.get(ALSO_CALLED.get(name, name))
            if interval and None not in interval:
                signs = (1, -1) if name in SIGN_FREE and not outcome.key.get("angle") else (1,)
                answers.append(any(min(interval) <= sign * truth <= max(interval) for sign in signs))
    return answers


def rate(outcomes: Iterable[Outcome], answer: Answer) -> dict[str, Any]:
    """Share of outcomes with a true ``answer``, and Wilson's 95 % interval (J. Am. Stat. Assoc. 22, 209, 1927)."""
    answers = [answer(outcome) for outcome in outcomes]
    return share(sum(answers), len(answers))


def share(k: int, n: int) -> dict[str, Any]:
    if n == 0:
        return {"of": 0, "rate": None, "ci95": None}
    z, p = 1.959964, k / n
    middle, spread = p + z * z / (2 * n), z * np.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    bounds = [float((middle + sign * spread) / (1 + z * z / n)) for sign in (-1, 1)]
    return {"of": n, "rate": p, "ci95": [max(0.0, bounds[0]), min(1.0, bounds[1])]}


def summary(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """All results, ready for JSON."""
    kinds = {
        kind: [outcome for outcome in outcomes if outcome.key["kind"] == kind]
        for kind in ("none", "one", "two", "unlisted")
    }
    kinds["none"] = [outcome for outcome in kinds["none"] if not outcome.key["effects"]]  # drifts may be present
    one, two, unlisted = kinds["one"], kinds["two"], kinds["unlisted"]
    heldout = [finding["heldout"] for outcome in one if right_name(outcome) for finding in findings(outcome)[:1]]
    answers = [answer for outcome in one + two for answer in intervals_hit(outcome)]
    return {
        "recordings": {kind: len(of_kind) for kind, of_kind in kinds.items()},
        "rates": {
            "false alarm, white noise": rate((r for r in kinds["none"] if not r.key["coloured"]), false_alarm),
            "false alarm, coloured noise": rate((r for r in kinds["none"] if r.key["coloured"]), false_alarm),
            "right name, one effect, clear": rate(filter(clear, one), right_name),
            "right name, one effect, any": rate(one, right_name),
            "named class holds the truth, visible": rate(filter(visible, one), right_class),
            "right stage, visible": rate(filter(visible, one), right_stage),
            "right stage, confounders of other stages clear": rate(filter(stage_clear, one), right_stage),
            "both named, two effects, clear": rate(filter(clear, two), both_named),
            "both named, two effects, any": rate(two, both_named),
            "unknown and right stage, unlisted, clear": rate(filter(clear, unlisted), unknown_in_place),
            "unknown and right stage, unlisted, any": rate(unlisted, unknown_in_place),
            "unknown, unlisted, any stage": rate(unlisted, lambda outcome: first_name(outcome) == "unknown"),
            "95 % intervals that hold the truth": share(sum(answers), len(answers)),
        },
        "heldout": {
            "before": median(h["before"] for h in heldout) if heldout else None,
            "after": median(h["after"] for h in heldout) if heldout else None,
        },
        "seconds": {family: _seconds([r.seconds for r in outcomes if r.key["family"] == family]) for family in SECONDS},
        "confusion": _confusion(kinds["none"] + one + unlisted),
        "wrong": [_account(outcome) for outcome in outcomes if not _right(outcome)],
        "failures": {outcome.name: outcome.failure for outcome in outcomes if outcome.failure},
    }


def _seconds(seconds: Sequence[float]) -> dict[str, Any]:
    if not seconds:
        return {"of": 0}
    return {
        "of": len(seconds),
        "median": median(seconds),
        "longest": max(seconds),
        "over a minute": sum(s > 60 for s in seconds),
    }


def markdown(score: dict[str, Any]) -> str:
    """The summary in Markdown."""
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
    for family, seconds in score["seconds"].items():
        if seconds["of"]:
            called, goal = SECONDS[family]
            text = f"{seconds['median']:.0f}, {seconds['longest']:.0f}; {seconds['over a minute']} over 60"
            lines.append(f"| seconds, {called}: median, longest | {text} | | {seconds['of']} | {goal} |")
    lines += ["", "| injected | named first (times) |", "|---|---|"]
    for truth, names in score["confusion"].items():
        lines.append(f"| {truth} | {', '.join(f'{name} ({count})' for name, count in names.items())} |")
    if score["wrong"]:
        lines += ["", "| recording | injected | distance, nearest | answer |", "|---|---|---|---|"]
        lines += [f"| {w['name']} | {w['injected']} | {w['distance']} | {w['answer']} |" for w in score["wrong"]]
    return "\n".join(lines) + "\n"


def _right(outcome: Outcome) -> bool:
    answers: dict[str, Answer] = {
        "none": lambda r: not false_alarm(r), "one": right_name, "two": both_named, "unlisted": unknown_in_place,
    }  # fmt: skip
    return answers[outcome.key["kind"]](outcome)


def _confusion(outcomes: Iterable[Outcome]) -> dict[str, dict[str, int]]:
    counts: dict[str, Counter[str]] = {}
    for outcome in outcomes:
        injected = outcome.key["effects"][0]["effect"] if outcome.key["effects"] else "none"
        counts.setdefault(injected, Counter())[first_name(outcome)] += 1
    return {injected: dict(counts[injected].most_common()) for injected in sorted(counts)}


def _account(outcome: Outcome) -> dict[str, str]:
    """One line on a wrong answer."""
    effects = outcome.key["effects"]
    apart = [f"{e['distance']:.1f} {e['nearest']}" for e in effects if "distance" in e]
    answer = [f"{finding['effect']} ({finding['stage']})" for finding in findings(outcome)] or [first_name(outcome)]
    return {
        "name": outcome.name,
        "injected": " + ".join(f"{e['effect']} ({e['stage']})" for e in effects) or "none",
        "distance": ", ".join(apart) or "-",
        "answer": ", ".join(answer),
    }
