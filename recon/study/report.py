"""The report of a study: blur over phase error, where the bound p/m is satisfied, estimators compared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle, product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.imaging import blur
from recon.report.figures import COLOURS, figure_uri, new_figure, use_plain_ticks
from recon.report.page import Figure, Section, Table, render
from recon.study.plan import Study
from recon.study.table import Columns
from scanner.arrays import Array
from scanner.device import AXES
from scanner.wording import counted

MARKERS = "o^sDv"
"""Markers of the phantoms, repeated if there are more. All of them can be filled in the ways of FILLS_AND_LINES."""

ESTIMATOR_COLOURS = (*COLOURS, "#4aa3a2", "#7a7a7a", "#d08fb2")
"""Colours of the estimators."""

FILLS_AND_LINES = (("full", "-"), ("none", "--"), ("left", ":"), ("right", "-."))
"""Fill of the markers and style of the lines of an estimator: the first while there are colours, then the next. Users
may add estimators."""

MIN_PHASE_ERROR_DEG = 1e-4
"""Phase errors below this value are drawn at it, because a logarithmic axis has no zero."""


def study_report(study: Study, data: Columns, summary: Mapping[str, Any]) -> str:
    """The page.

    Args:
        data: the study's table as columns (``recon.study.table.table_columns``).
    """
    subject = (
        f"Phantoms {len(study.phantoms)}, scan designs {len(study.designs)}, drifts {len(study.drifts)}, noise levels "
        f"{max(1, len(study.snr_db))}, seeds {study.seeds}, estimators {len(study.estimators)}, resolutions "
        f"{len(study.pixels)}, values of p {len(study.p)}: {counted(summary['cells'], 'cell')}, "
        f"{summary['failed']} failed."
    )
    worked = {name: column[data["failed"] == ""] for name, column in data.items()}
    notes = [f"failed: {reason}" for reason in summary["reasons"]]
    sections = [Section("Estimators", ESTIMATORS_TEXT, _estimators(summary["estimators"]))]
    if worked["seed"].size:
        maps = [_bound_map(study, worked, design.name) for design in study.designs]
        sections += [
            Section("Blur over phase error", BLUR_TEXT, figures=[_blur_figure(study, worked)], least="40rem"),
            Section("Where the bound is satisfied", MAP_TEXT, figures=maps, least="40rem"),
            Section(
                "Estimators compared",
                COMPARISON_TEXT,
                _win_table(study, worked),
                [_error_figure(study, worked)],
                "24rem",
            ),
        ]
    return render(study.name, summary["conclusion"], sections, notes, subject)


ESTIMATORS_TEXT = (
    "Over all recordings, resolutions and both axes. Phase error: rms over a scan. Picture error: rms against the "
    "noiseless scene, in units of the scene's contrast."
)
BLUR_TEXT = (
    "Top: blur by the phase error; δφ displaces a sample by m δφ cos α pixels, rms m δφ/√2 (line). Bottom: rms error "
    "of the picture, which is measured independently, over the rms phase error of both axes. The marker shows the "
    "phantom. Dashed: the bound p/m."
)
MAP_TEXT = "Percentage of the scan with a phase error within ±p/m: mean over phantoms, noise, seeds and axes."
COMPARISON_TEXT = (
    "How often, in per cent of recordings and axes, the estimator of the row has a smaller phase error than that of "
    "the column; both estimated the same recordings. Below, phase error: median, and the 10th to the 90th percentile."
)


def _estimators(statistics: Mapping[str, Mapping[str, float | None]]) -> Table:
    head = ["", "phase error, median [°]", "95th percentile [°]", "scan within ±p/m", "picture error", "time [s]"]
    rows = []
    for name, values in statistics.items():
        formats = {
            "phase_rmse_deg_median": ".4f", "phase_rmse_deg_p95": ".4f", "within_bound": ".1%",
            "picture_error_median": ".3f", "seconds_median": ".2f", "failed": ".1%",
        }  # fmt: skip
        rows.append([name, *("–" if (v := values[key]) is None else format(v, spec) for key, spec in formats.items())])
    return Table([*head, "failed"], rows)


def _blur_figure(study: Study, data: Columns) -> Figure:
    drawing, axes = new_figure(2, len(study.pixels), (max(5.0, 4.5 * len(study.pixels)), 6.4))
    for (above, below), pixels in zip(axes.T, study.pixels, strict=True):
        here = (data["pixels"] == pixels) & (data["p"] == study.p[0])  # neither blur nor picture depends on p
        law = np.geomspace(max(MIN_PHASE_ERROR_DEG, data["phase_rmse_deg"][here].min(initial=1.0)), 20.0, 50)
        above.plot(law, 0.5 * pixels * np.radians(law) / np.sqrt(2.0), color="#444", lw=0.8)
        for name, of_estimator in _estimator_styles(study.estimators).items():
            for phantom, sign in zip(study.phantoms, cycle(MARKERS), strict=False):
                x, y = (
                    here & (data["estimator"] == name) & (data["phantom"] == phantom) & (data["axis"] == axis)
                    for axis in AXES
                )
                label = name if phantom == study.phantoms[0] else None
                style = of_estimator | {"marker": sign, "ls": "", "ms": 4, "alpha": 0.6}
                error = np.maximum(data["phase_rmse_deg"], MIN_PHASE_ERROR_DEG)
                above.loglog(error[x | y], data["blur_phase_px"][x | y], label=label, **style)
                below.loglog(np.hypot(error[x], error[y]) / np.sqrt(2.0), data["picture_error"][x], **style)
        for panel in (above, below):
            panel.set_xlabel("phase error, rms [°]")
            for p in study.p:
                bound = np.degrees(blur.phase_bound(p, pixels / 2))
                panel.axvline(bound, color="#444", lw=0.8, ls="--")
                panel.text(bound, 0.98, f" p = {p:g}", transform=panel.get_xaxis_transform(), va="top", fontsize=7)
        above.set_title(f"{pixels} × {pixels} pixels", fontsize=9)
        for axis in (above.xaxis, above.yaxis, below.xaxis, below.yaxis):
            use_plain_ticks(axis)
    axes[0, 0].set_ylabel("blur by phase, rms [px]")
    axes[1, 0].set_ylabel("picture error")
    axes[0, 0].legend(frameon=False, fontsize=8)
    return Figure(
        figure_uri(drawing),
        "blur by the phase error, a marker a scan and axis; picture error, a marker a scan",
    )


def _bound_map(study: Study, data: Columns, design: str) -> Figure:
    """Fraction of the scan within the bound over (resolution, drift): a panel for each p and estimator."""
    drifts = sorted(study.drifts)
    pixels = sorted(study.pixels)
    size = (1.2 + 2.2 * len(study.estimators), 0.9 + (0.6 + 0.28 * len(drifts)) * len(study.p))
    drawing, axes = new_figure(len(study.p), len(study.estimators), size)
    for row, p in enumerate(study.p):
        for column, name in enumerate(study.estimators):
            chosen = (data["design"] == design) & (data["p"] == p) & (data["estimator"] == name)
            held = _mean_within_bound(data, chosen, ("drift", drifts), ("pixels", [float(n) for n in pixels]))
            panel = axes[row, column]
            panel.imshow(held, vmin=0.0, vmax=1.0, cmap="RdYlGn", alpha=0.6, aspect="auto")
            for i, j in np.ndindex(held.shape):
                if np.isfinite(held[i, j]):
                    panel.text(j, i, f"{100 * held[i, j]:.0f}", ha="center", va="center", fontsize=8, color="#111")
            panel.set(
                xticks=range(len(pixels)),
                xticklabels=[f"{n}" for n in pixels] if p == study.p[-1] else [],
                yticks=range(len(drifts)),
                yticklabels=[f"{100 * d:g} %" for d in drifts] if column == 0 else [],
            )
            if row == 0:
                panel.set_title(name, fontsize=9)
            if column == 0:
                panel.set_ylabel(f"drift, p = {p:g}")
    drawing.supxlabel("pixels across", fontsize=9)
    return Figure(figure_uri(drawing), f"{design}: per cent of the scan within ±p/m, by resolution and drift")


def _mean_within_bound(
    data: Columns, chosen: NDArray[np.bool_], rows: tuple[str, Sequence[float]], across: tuple[str, Sequence[float]]
) -> Array:
    """Mean of ``within_bound`` over the chosen rows at each pair of two columns' values; nan where there are none."""
    out = np.full((len(rows[1]), len(across[1])), np.nan)
    for i, j in np.ndindex(out.shape):
        own = chosen & (data[rows[0]] == rows[1][i]) & (data[across[0]] == across[1][j])
        if own.any():
            out[i, j] = np.mean(data["within_bound"][own])
    return out


def _win_table(study: Study, data: Columns) -> Table:
    """For each pair of estimators, in which part of what both did the row's has the smaller phase error."""
    errors: dict[str, dict[tuple[Any, ...], float]] = {name: {} for name in study.estimators}
    once = (data["pixels"] == study.pixels[0]) & (data["p"] == study.p[0])  # a phase error depends on neither
    scans = zip(*(data[name][once] for name in ("phantom", "design", "drift", "snr_db", "seed", "axis")), strict=True)
    names, values = data["estimator"][once], data["phase_rmse_deg"][once]
    for scan, name, value in zip(scans, names, values, strict=True):
        errors[str(name)][tuple(str(each) for each in scan)] = float(value)

    def wins(row: str, column: str) -> str:
        both = errors[row].keys() & errors[column].keys()
        if row == column or not both:
            return "–"
        return f"{100 * np.mean([errors[row][scan] < errors[column][scan] for scan in both]):.0f}"

    table = [[row, *(wins(row, column) for column in study.estimators)] for row in study.estimators]
    return Table(["", *study.estimators], table)


def _error_figure(study: Study, data: Columns) -> Figure:
    panels = [("drift", "drift of the stiffness [%]", 100.0)]
    if len(study.snr_db) > 1:
        panels.append(("snr_db", "SNR of the sense signal [dB]", 1.0))
    drawing, axes = new_figure(1, len(panels), (4.6 * len(panels), 3.2))
    for panel, (what, label, unit) in zip(axes[0], panels, strict=True):
        for name, style in _estimator_styles(study.estimators).items():
            own = data["estimator"] == name
            at = np.unique(data[what][own])
            if not at.size:
                continue
            error = [
                np.maximum(data["phase_rmse_deg"][own & (data[what] == value)], MIN_PHASE_ERROR_DEG) for value in at
            ]
            low, median, high = np.array([np.percentile(each, [10, 50, 90]) for each in error]).T
            panel.fill_between(unit * at, low, high, color=style["color"], alpha=0.15, lw=0)
            panel.plot(unit * at, median, marker="o", ms=3, lw=1.2, label=name, **style)
        panel.set(yscale="log", xlabel=label, xticks=unit * np.unique(data[what]))
        use_plain_ticks(panel.yaxis)
    axes[0, 0].set_ylabel("phase error, rms [°]")
    axes[0, 0].legend(frameon=False, fontsize=8)
    return Figure(figure_uri(drawing), "phase error of each estimator: median, 10th to 90th percentile")


def _estimator_styles(names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Colour, fill of the markers and style of the lines of each estimator, the same in all figures of a study."""
    styles = cycle(product(FILLS_AND_LINES, ESTIMATOR_COLOURS))
    return {
        name: {"color": colour, "fillstyle": fill, "ls": line}
        for name, ((fill, line), colour) in zip(names, styles, strict=False)
    }
