"""The page of several reconstructions: a table, and the pictures with links to their reports."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote

from recon.report.conclusions import conclude_many
from recon.report.page import Figure, Section, Table, render
from scanner.device import AXES


def reconstructions_report(summary: Mapping[str, Any]) -> str:
    """The page; ``summary`` is the content of summary.json."""
    done = [row for row in summary["recordings"] if not row["failed"]]
    heads = [
        "recording",
        "samples",
        "fill",
        *(f"within ±p/m, {a}" for a in AXES),
        *(f"phase ±1 sd, {a} [°]" for a in AXES),
    ]
    rows = [
        [
            Path(row["output"]).name,
            str(row["samples"]),
            f"{row['fill']:.1%}",
            *(f"{row['within_bound'][axis]:.1%}" for axis in AXES),
            *(f"{row['phase_sd_deg'][axis]:.2g}" for axis in AXES),
            str(len(row["trouble"])),
        ]
        for row in done
    ]
    names = [Path(row["output"]).name for row in done]
    pictures = [Figure(f"{quote(name)}/image.png", name, f"{quote(name)}/report.html") for name in names]
    sections = [
        Section("Recordings", "", Table([*heads, "defects"], rows)),
        Section("Pictures", "The captions link to the reports.", figures=pictures, pixelated=True),
    ]
    notes = [f"{Path(row['output']).name}: {limit}" for row in done for limit in row["limits"]]
    notes += [row["failed"] for row in summary["recordings"] if row["failed"]]
    notes += summary["stack"]["notes"] if summary["stack"] else []
    return render(
        "Reconstructions", conclude_many(summary), sections, notes, f"Computed in {summary['seconds']:.1f} s."
    )
