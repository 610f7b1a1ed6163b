"""The page of ``diagnose --each``: which effects how many devices have, and their sizes device by device."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from recon.report.conclusions import conclude_fleet
from recon.report.figures import COLOURS, NARROW_WIDTH_IN, figure_uri, new_figure
from recon.report.numbers import format_interval, format_probability, format_value
from recon.report.page import Figure, Section, Table, render
from scanner.wording import counted

MAX_FIGURES = 6
"""Effects with a figure: those that most devices have."""

Row = Mapping[str, Any]


def fleet_report(summary: Mapping[str, Any]) -> str:
    """The report page of ``diagnose --each``, made of its ``summary``."""
    rows = [row for row in summary["table"] if not row.get("failed")]
    groups = _by_parameter(rows)
    head = ["axis and effect", "parameter", "recordings", "median", "smallest", "largest", "unit"]
    effects = [
        [f"{axis} {effect}", parameter, str(len(group)), *_spread(group), str(group[0]["unit"])]
        for (axis, effect, parameter), group in groups
    ]
    figures = [
        Figure(_sizes(group, f"{parameter} [{group[0]['unit']}]"), f"{axis} {effect}: {parameter}, 95 % intervals.")
        for (axis, effect, parameter), group in groups[:MAX_FIGURES]
        if parameter
    ]
    each_head = ["recording", "device", "verdict", "axis and effect", "size", "probability"]
    sections = [
        Section("Effects", "", Table(head, effects), figures, least="22rem"),
        Section("Recordings", "A folder of each holds its diagnosis.", Table(each_head, [_line(row) for row in rows])),
    ]
    failed = [row["failed"] for row in summary["table"] if row.get("failed")]
    subject = f"{counted(summary['recordings'], 'recording')}, computed in {summary['seconds']:.1f} s."
    return render("Diagnosis of many devices", conclude_fleet(summary), sections, failed, subject)


def _by_parameter(rows: Sequence[Row]) -> list[tuple[tuple[str, str, str], list[Row]]]:
    """Rows with a finding by axis, effect and parameter, the most frequent first."""
    groups: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        if row.get("effect"):
            groups.setdefault((row["axis"], row["effect"], row.get("parameter") or ""), []).append(row)
    return sorted(groups.items(), key=lambda item: (-len(item[1]), item[0]))


def _spread(group: Sequence[Row]) -> list[str]:
    values = [row["value"] for row in group if row.get("value") is not None]
    if not values:
        return ["", "", ""]
    return [format_value(float(value)) for value in (np.median(values), min(values), max(values))]


def _line(row: Row) -> list[str]:
    if not row.get("effect"):
        return [row["recording"], row["device"], row["verdict"], "", "", ""]
    size = ""
    if row.get("value") is not None and row.get("ci95_low") is not None and row.get("ci95_high") is not None:
        interval = format_interval(row["value"], row["ci95_low"], row["ci95_high"], row["unit"] or "")
        size = f"{row['parameter']} = {interval}"
    probability = format_probability(row["probability"]) if row["probability"] is not None else ""
    return [row["recording"], row["device"], row["verdict"], f"{row['axis']} {row['effect']}", size, probability]


def _sizes(group: Sequence[Row], label: str) -> str:
    """One parameter of one effect: a line with its interval for each recording."""
    drawn = [row for row in group if row.get("value") is not None]
    drawing, axes = new_figure(1, 1, (NARROW_WIDTH_IN, 1.2 + 0.18 * max(len(drawn), 4)))
    panel = axes[0, 0]
    for k, row in enumerate(drawn):
        low, high = row.get("ci95_low"), row.get("ci95_high")
        if low is not None and high is not None:
            panel.plot([low, high], [k, k], color=COLOURS[0], lw=1.5)
        panel.plot(row["value"], k, "o", ms=3, color=COLOURS[0])
    names = [Path(row["recording"]).stem for row in drawn]
    panel.set_yticks(range(len(drawn)), names, fontsize=7, parse_math=False)
    panel.invert_yaxis()
    panel.locator_params(axis="x", nbins=5)  # labels of five digits side by side
    panel.set_xlabel(label)
    return figure_uri(drawing)
