"""The page that compares several estimators on one simulated recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from recon.imaging.picture import Picture
from recon.report.figures import (
    contrast_limits,
    data_uri,
    encode_png,
    fill_small_holes,
    to_rgb,
)
from recon.report.page import Figure, Section, Table, render
from recon.report.reconstruction import (
    BLUR_TEXT,
    _format_picture_phase,
    _phase_text,
    blur_figure_of,
    coverage_figure,
    phase_figures,
    scale_bar,
)
from recon.report.summary import is_mirrored
from recon.steps.reconstruction import Reconstruction
from scanner.device import AXES


def comparison_report(
    title: str,
    lead: str,
    results: Mapping[str, Reconstruction],
    summaries: Mapping[str, Mapping[str, Any]],
    further: Sequence[Section] = (),
) -> str:
    """Several reconstructions of one recording side by side; the last is the reference for contrast and accuracy.

    Args:
        title: heading.
        lead: what was recorded, in a sentence or two.
        results, summaries: by name of the estimator, the reference last.
        further: sections to end with.
    """
    *estimated, reference = results
    first = results[estimated[0]]
    limits = contrast_limits(results[reference].picture.image)
    pictures, enlarged = [], []
    bar = scale_bar(first.picture.grid)
    for name, result in results.items():
        image = fill_small_holes(upright_picture(result))
        pictures.append(Figure(picture_data_uri(image, limits), picture_caption(name, summaries[name]), scale_bar=bar))
        enlarged.append(
            Figure(
                picture_data_uri(_central_part(image), limits),
                f"{name}, the middle enlarged",
                scale_bar=scale_bar(first.picture.grid, 0.25),
            )
        )
    best = summaries[reference]["picture"]["rms"]
    columns = [[*_accuracy_cells(summaries[name]), _picture_cell(summaries[name]["picture"], best)] for name in results]
    whats = ("phase error, rms,", "scan within ±p/m,", "phase error measured in the picture,")
    heads = [*(f"{what} {axis}" for axis in AXES for what in whats), "picture error"]
    rows = [[head, *cells] for head, *cells in zip(heads, *columns, strict=True)]
    blurs = {name: _both_axes(summaries[name]) for name in estimated}
    coverage = coverage_figure(first.picture.coverage, bar)
    tracked = {name: results[name] for name in estimated}
    sections = [
        Section("One recording, one picture an estimator", figures=pictures, least="11rem", pixelated=True),
        Section("Enlarged", figures=enlarged, least="11rem", pixelated=True),
        Section("Accuracy", PICTURE_TEXT, Table(["", *results], rows)),
        Section("Phase", _phase_text(first), None, phase_figures(tracked), "26rem"),
        Section("Blur", BLUR_TEXT, figures=[blur_figure_of(blurs, first.p)], least="30rem"),
        Section("Coverage", figures=[coverage], least="20rem", pixelated=True),
        *further,
    ]
    return render(title, _compare(estimated, summaries), sections, subject=lead)


PICTURE_TEXT = (
    "Phase errors against the truth of the simulation, rms over the scan. The phase error measured in the picture "
    "needs no truth: it is the displacement between forward and backward half-periods. Picture error: rms difference "
    "to the noiseless scene over visited pixels after a common magnification, and its ratio to that of the true motion."
)


def _compare(names: Sequence[str], summaries: Mapping[str, Mapping[str, Any]]) -> str:
    """The best estimator and the factor by which it beats the worst."""
    worst_axis = {name: max(summaries[name][axis]["phase_rmse_deg"] for axis in AXES) for name in names}
    best, worst = min(names, key=worst_axis.__getitem__), max(names, key=worst_axis.__getitem__)
    within = min(summaries[best][axis]["within_bound"] for axis in AXES)
    return (
        f"Use {best}: its phase error is {worst_axis[best]:.2g}° rms in the worse axis, against "
        f"{worst_axis[worst]:.2g}° with {worst}, and {within:.1%} of its scan lies within the bound p/m."
    )


def _accuracy_cells(summary: Mapping[str, Any]) -> list[str]:
    cells = []
    for axis in AXES:
        values = summary[axis]
        error = f"{values['phase_rmse_deg']:.3f}°" if "phase_rmse_deg" in values else ""
        cells += [error, f"{values['within_bound']:.1%}", _format_picture_phase(values["picture_phase_error_deg"])]
    return cells


def _both_axes(summary: Mapping[str, Any]) -> dict[str, float]:
    """Blur by cause, the displacements of both axes added in quadrature [px]."""
    return {
        cause: float(np.hypot(*(summary[axis]["blur_px"][cause] for axis in AXES))) for cause in summary["x"]["blur_px"]
    }


def _picture_cell(picture: Mapping[str, float], best: float) -> str:
    return f"{picture['rms']:.4f} ({picture['rms'] / best:.3f} ×)"


def upright_picture(result: Reconstruction) -> Picture:
    """The picture as the scene lies: axes whose sign the recording leaves open are turned as in the truth."""
    flip_x, flip_y = is_mirrored(result)
    rows, columns = (slice(None, None, -1 if flip else 1) for flip in (flip_y, flip_x))
    picture = result.picture
    return replace(picture, image=picture.image[rows, columns], coverage=picture.coverage[rows, columns])


def _central_part(image: Any) -> Any:
    height, width = image.shape[:2]
    return image[3 * height // 8 : 5 * height // 8, 3 * width // 8 : 5 * width // 8]


def picture_caption(name: str, summary: Mapping[str, Any]) -> str:
    """A picture's name with its phase errors."""
    if not all("phase_rmse_deg" in summary[a] for a in AXES):
        return name
    x, y = (f"{summary[axis]['phase_rmse_deg']:.2g}°" for axis in AXES)
    return f"{name}: phase error {x} in x, {y} in y"


def picture_data_uri(image: Any, limits: tuple[float, float] | None = None) -> str:
    """A picture as data URI."""
    return data_uri(encode_png(to_rgb(image, limits)))
