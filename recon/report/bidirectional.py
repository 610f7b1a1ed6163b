"""The report of ``bidirectional``: line phase over the film, its lag across the field, a frame before and after."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from recon.film_correction import CorrectedFilm
from recon.imaging.raster.line_phase import lag_at
from recon.io.film import Film
from recon.report.figures import (
    COLOURS,
    LEGEND,
    NARROW_WIDTH_IN,
    contrast_limits,
    data_uri,
    encode_png,
    figure_uri,
    min_max_envelope,
    new_figure,
    to_rgb,
)
from recon.report.numbers import format_ends, format_uncertain, format_value
from recon.report.page import Figure, Section, Table, render
from recon.report.reconstruction import round_scale_bar
from scanner.arrays import Array
from scanner.wording import counted

PHASE_CAPTION = (
    "Shift between the two directions in every frame. Points: the frame by itself; line and band: smoothed over time, "
    "±2 standard deviations."
)
LAG_CAPTION = (
    "Shift across the field as a fraction of that at the middle. Points: measured in groups of columns, ±2 standard "
    "errors; line: the law that the film is corrected by."
)


def bidirectional_report(result: CorrectedFilm, summary: Mapping[str, Any]) -> str:
    """The page; ``summary`` is the content of summary.json."""
    fill, phase = summary["fill_fraction"], summary["phase_deg"]
    rms = summary["rows_rms"]
    rows = [
        [
            "shift between the directions, median",
            format_uncertain(summary["shift_px"]["median"], summary["shift_px"]["sd"], "px"),
        ],
        ["smallest and largest", f"{summary['shift_px']['min']:.3f} to {summary['shift_px']['max']:.3f} px"],
        ["phase error of the scan, median", "not determined" if phase is None else f"{phase:.3f}°"],
        ["lag", summary["lag"]],
        [
            "fill fraction (columns over sweep)",
            format_uncertain(fill["value"], fill["sd"]) if fill else "not determined",
        ],
        ["lines less their neighbours, rms: as recorded", format_value(rms["recorded"])],
        ["the same, corrected", format_value(rms["corrected"])],
        ["the same, with one shift for all columns", format_value(rms["one_shift_for_all_columns"])],
    ]
    if counts := summary["counts"]:
        rows.append(["counts: recorded", f"{counts['recorded']:.10g}"])
        rows.append(
            [
                "counts: in the corrected film, beyond its border",
                f"{counts['corrected']:.10g}, {counts['beyond_border']:.10g}",
            ]
        )
    figures = [
        Figure(
            _phase_figure(result),
            PHASE_CAPTION,
        ),
        Figure(
            _lag_figure(result),
            LAG_CAPTION,
        ),
    ]
    limits = contrast_limits(result.before)
    bar, grey = _scale_bar(result.film), format_ends(*limits)
    pictures = [
        Figure(_picture(picture, limits), caption, scale_bar=bar, grey_scale=grey)
        for picture, caption in ((result.before, "As recorded: the middle of one frame."), (result.after, "Corrected."))
    ]
    sections = [
        Section("Line phase", "", Table(["quantity", "value"], rows), figures),
        Section("Pictures", "", figures=pictures, pixelated=True),
    ]
    size = f"{counted(summary['frames'], 'frame')} of {summary['columns']} x {summary['lines']} pixels"
    subject = f"{summary['film']}: {size}, channels: {summary['channels']}."
    return render("Bidirectional scan", summary["conclusion"], sections, summary["notes"], subject)


def _phase_figure(result: CorrectedFilm) -> str:
    drawing, axes = new_figure(1, 1, (NARROW_WIDTH_IN, 2.6))
    panel, frame = axes[0, 0], np.arange(result.shift.size, dtype=np.float64)
    panel.plot(*min_max_envelope(frame, result.measured), ".", color="#888", ms=3, label="frame by itself")
    at, low = min_max_envelope(frame, result.shift - 2 * result.sd)
    panel.fill_between(
        at, low, min_max_envelope(frame, result.shift + 2 * result.sd)[1], color=COLOURS[0], alpha=0.25, lw=0
    )
    panel.plot(*min_max_envelope(frame, result.shift), color=COLOURS[0], lw=1.2, label="smoothed")
    panel.set(xlabel="frame", ylabel="shift [px]")
    panel.legend(**LEGEND, ncols=2)
    return figure_uri(drawing)


def _lag_figure(result: CorrectedFilm) -> str:
    drawing, axes = new_figure(1, 1, (NARROW_WIDTH_IN, 2.6))
    panel, lag, columns = axes[0, 0], result.model.lag, result.film.shape[-1]
    column = 0.5 * columns * (1.0 + lag.place)
    panel.errorbar(column, lag.value, 2 * lag.sd, fmt="o", ms=3, color="#444", label="measured")
    u = np.linspace(-1.0, 1.0, 101)
    panel.plot(0.5 * columns * (1.0 + u), lag_at(u, result.model.fill**2), color=COLOURS[0], lw=1.2, label="law")
    panel.set(xlabel="column", ylabel="shift / shift at the middle")
    panel.legend(**LEGEND, ncols=2)
    return figure_uri(drawing)


def _scale_bar(film: Film) -> tuple[str, float]:
    """Scale bar of the shown part of a frame: in the unit of length that ImageJ states in the film, else in pixels."""
    columns = film.shape[-1]
    width, unit = float(columns - 2 * (columns // 4)), "px"
    stated = str(film.description.get("metadata", {}).get("unit", "")).replace("\\u00B5", "µ")
    pixels_per_unit = film.description.get("resolution", (0.0,))[0]
    if stated not in ("", "pixel") and 0.0 < pixels_per_unit < np.inf:
        width, unit = width / pixels_per_unit, stated
    return round_scale_bar(width, unit)


def _picture(picture: Array, limits: tuple[float, float]) -> str:
    """The middle quarter of a frame as PNG."""
    rows, columns = picture.shape
    part = picture[rows // 4 : rows - rows // 4, columns // 4 : columns - columns // 4]
    return data_uri(encode_png(to_rgb(part, limits)))
