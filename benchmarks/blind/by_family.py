"""Rates by family: names, stages, false alarms, intervals, reliability, open-loop errors and times."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from statistics import median
from typing import Any

import numpy as np
from scipy.stats import beta

from benchmarks.blind.outcome import Outcome
from benchmarks.blind.table import clear, findings, intervals_hit, same_axis

WORSE = 1.02
"""Ratio of open-loop errors above which the improved device counts as worse. Noise alone makes about 1 %."""
RELIABILITY_BINS = ((0.9, 0.99), (0.99, 1.0 + 1e-9))
"""Ranges of stated probability in which the fraction of right names is compared with what was stated."""


def right_names(effect: dict[str, Any]) -> set[str]:
    """The names that describe an effect of the key."""
    return {effect["effect"], *effect.get("also_right", [])}


def is_true(outcome: Outcome, finding: dict[str, Any]) -> bool:
    """Whether a finding names an effect of the key, in its axis."""
    return any(
        finding["effect"] in right_names(effect) and same_axis(effect, finding) for effect in outcome.key["effects"]
    )


def first_answer(outcome: Outcome) -> dict[str, Any] | None:
    """The first finding about the concealed effect: those that name another effect of the key are passed over."""
    others = outcome.key["effects"][1:]
    for finding in findings(outcome):
        if not any(finding["effect"] in right_names(other) and same_axis(other, finding) for other in others):
            return finding
    return None


def named_right(outcome: Outcome) -> bool:
    """Whether the first answer is the concealed effect."""
    answer = first_answer(outcome)
    return answer is not None and answer["effect"] in right_names(outcome.key["effects"][0])


def stage_right(outcome: Outcome) -> bool:
    """Whether the first answer has the stage of the concealed effect."""
    answer = first_answer(outcome)
    return answer is not None and answer["stage"] == outcome.key["effects"][0]["stage"]


def is_unknown(outcome: Outcome) -> bool:
    """Whether the first answer is ``unknown``."""
    answer = first_answer(outcome)
    return answer is not None and answer["effect"] == "unknown"


def has_false_alarm(outcome: Outcome) -> bool:
    """Whether there is no diagnosis, or a finding of what the key does not hold."""
    return outcome.diagnosis is None or any(not is_true(outcome, finding) for finding in findings(outcome))


def upper_bound(k: int, n: int, confidence: float = 0.95) -> float:
    """One-sided upper bound of a rate with k of n (Clopper and Pearson, Biometrika 26, 404, 1934)."""
    return float(beta.ppf(confidence, k + 1, n - k)) if k < n else 1.0


def lower_bound(k: int, n: int, confidence: float = 0.95) -> float:
    """One-sided lower bound of a rate with k of n (Clopper and Pearson 1934)."""
    return float(beta.ppf(1 - confidence, k, n - k + 1)) if k else 0.0


def _rate(answers: Iterable[bool]) -> dict[str, Any]:
    values = list(answers)
    k, n = sum(values), len(values)
    return {
        "right": k,
        "of": n,
        "lower95": lower_bound(k, n) if n else None,
        "upper95": upper_bound(k, n) if n else None,
    }


def summarise_families(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """By family, and for all together, the rates that the report shows."""
    families = sorted({outcome.key["family"] for outcome in outcomes})
    groups = {family: [o for o in outcomes if o.key["family"] == family] for family in families}
    return {name: summarise(group) for name, group in {**groups, "all": list(outcomes)}.items()}


def summarise(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Rates of one group of outcomes."""
    none = [o for o in outcomes if o.key["kind"] == "none"]
    named = [o for o in outcomes if o.key["kind"] in ("one", "two")]
    unlisted = [o for o in outcomes if o.key["kind"] == "unlisted"]
    imperfect = [o for o in named if o.key.get("imperfection")]
    stated = [
        (finding, is_true(o, finding)) for o in outcomes for finding in findings(o) if finding["effect"] != "unknown"
    ]
    ratios = [ratio for o in outcomes for ratio in open_loop_ratios(o)]
    return {
        "recordings": len(outcomes),
        "right name first, clear": _rate(named_right(o) for o in named if clear(o)),
        "right name first, any": _rate(named_right(o) for o in named),
        "right name first, imperfect": _rate(named_right(o) for o in imperfect),
        "right stage": _rate(stage_right(o) for o in named),
        "right stage, imperfect": _rate(stage_right(o) for o in imperfect),
        "false alarm": _rate(has_false_alarm(o) for o in none),
        "unknown where out of catalogue": _rate(is_unknown(o) for o in unlisted),
        "right stage where out of catalogue": _rate(stage_right(o) for o in unlisted),
        "intervals that contain the truth": _rate(hit for o in named for hit in intervals_hit(o)),
        "right of names with p 0.9 to 0.99": _rate(true for f, true in stated if _in_bin(f, RELIABILITY_BINS[0])),
        "right of names with p above 0.99": _rate(true for f, true in stated if _in_bin(f, RELIABILITY_BINS[1])),
        "improved device not worse, unused recording": _rate(ratio <= WORSE for ratio in ratios),
        "open-loop error, improved over nominal": {
            "median": median(ratios) if ratios else None,
            "largest": max(ratios, default=None),
        },
        "imaging, improved device": _imaging(outcomes),
        "seconds": {"median": median(o.seconds for o in outcomes), "longest": max(o.seconds for o in outcomes)},
        "failures": sum(bool(o.failure) for o in outcomes),
    }


def open_loop_ratios(outcome: Outcome) -> list[float]:
    """By channel of the unused recording, the improved device's open-loop error over the nominal device's.

    Infinite where the improved device gives no prediction and the nominal one does.
    """
    nominal, improved = outcome.open_loop.get("nominal", {}), outcome.open_loop.get("improved", {})
    ratios = {name: improved.get(name, np.inf) / nominal[name] for name in nominal}
    return [ratio if np.isfinite(ratio) else np.inf for ratio in ratios.values()]


def _imaging(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Errors of imaging scans with the improved device, and how often they are worse than with the nominal device."""
    pairs = [
        (o.imaging["nominal"], o.imaging["improved"]) for o in outcomes if {"nominal", "improved"} <= set(o.imaging)
    ]
    if not pairs:
        return {"of": 0}
    improved = [after for _, after in pairs]
    return {
        "of": len(pairs),
        "no reconstruction, improved device alone": sum("improved" not in o.imaging for o in outcomes if o.imaging),
        "largest phase error [deg]": max(e["phase_deg"] for e in improved),
        "worst field": max((e["field"] for e in improved), key=lambda ratio: abs(ratio - 1)),
        "largest picture error over that of the true motion": max(e["picture"] for e in improved),
        "phase worse than nominal": sum(after["phase_deg"] > WORSE * before["phase_deg"] for before, after in pairs),
        "picture worse than nominal": sum(after["picture"] > WORSE * before["picture"] for before, after in pairs),
    }


def _in_bin(finding: dict[str, Any], limits: tuple[float, float]) -> bool:
    return limits[0] <= finding.get("probability", 0.0) < limits[1]


def family_table(summary: dict[str, Any]) -> str:
    """The summary in Markdown: a row for a rate, a column for a family."""
    families = list(summary)
    lines = ["| | " + " | ".join(families) + " |", "|---" * (len(families) + 1) + "|"]
    lines.append("| recordings | " + " | ".join(str(summary[family]["recordings"]) for family in families) + " |")
    rates = [name for name, value in summary["all"].items() if isinstance(value, dict) and "right" in value]
    for name in rates:
        if summary["all"][name]["of"]:
            lines.append(f"| {name} | " + " | ".join(_cell(name, summary[family][name]) for family in families) + " |")
    for name in ("open-loop error, improved over nominal", "seconds"):
        cells = []
        for family in families:
            values = [value for value in summary[family][name].values() if value is not None]
            cells.append(" / ".join(f"{value:.3g}" for value in values))
        lines.append(f"| {name}: median / largest | " + " | ".join(cells) + " |")
    imaging = summary["all"]["imaging, improved device"]
    if imaging["of"]:
        lines += ["", "| imaging scans, improved device | |", "|---|---|"]
        lines += [f"| {name} | {value:.4g} |" for name, value in imaging.items()]
    return "\n".join(lines) + "\n"


def _cell(name: str, rate: dict[str, Any]) -> str:
    """``right of n``, with the bound that matters: upper for false alarms, lower for all else."""
    if not rate["of"]:
        return ""
    bound = f"≤ {rate['upper95']:.1%}" if name == "false alarm" else f"≥ {rate['lower95']:.1%}"
    return f"{rate['right']} of {rate['of']} ({bound})"
