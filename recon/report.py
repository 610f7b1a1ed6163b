"""The report: one HTML file that opens offline. The template escapes every text that comes from a recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from recon import views
from recon.pipeline import AXES, Reconstruction
from recon.summary import mirrored
from recon.sweeps import sweeps


@dataclass(frozen=True)
class Figure:
    """A picture in a data URI with its caption, which is its text for those who cannot see it too.

    Attributes:
        page: that the caption leads to, none if empty.
    """

    uri: str
    caption: str
    page: str = ""


@dataclass(frozen=True)
class Table:
    """Heads, and rows whose first cell names them."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True)
class Section:
    """A heading with what stands under it.

    Attributes:
        least: width below which figures no longer share a row (CSS).
        pixelated: show pixels as squares.
        sweeps: what the phase sliders map, see :func:`recon.sweeps.sweeps`; in one section of a page at the most.
    """

    heading: str
    text: str = ""
    table: Table | None = None
    figures: Sequence[Figure] = field(default_factory=tuple)
    least: str = "15rem"
    pixelated: bool = False
    sweeps: Mapping[str, Any] | None = None


def render(title: str, lead: str, sections: Sequence[Section], notes: Sequence[str] = ()) -> str:
    """The page."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(loader=PackageLoader("recon"), autoescape=True, undefined=StrictUndefined)
    page = environment.get_template("report.html")
    return page.render(title=title, lead=lead, sections=sections, notes=notes, unvisited=views.UNVISITED)


def reconstruction_report(result: Reconstruction, summary: Mapping[str, Any]) -> str:
    """One recording's report; a stretch of the intensity goes into the page, for the phase sliders."""
    grid = result.picture.grid
    lead = (
        f"{result.motion.estimator}: {summary['samples']} samples of {result.recorded * 1e3:.4g} ms on {grid.width} × "
        f"{grid.height} pixels, {summary['fill']:.1%} of them visited; {result.seconds:.2f} s to compute."
    )
    image = views.coloured(views.visible(result.picture))
    coverage = views.coverage_image(result.picture.coverage)
    pictures = [
        Figure(views.uri(views.png(image)), f"picture ({result.motion.estimator})"),
        Figure(views.uri(views.png(coverage)), "samples a pixel; blue: never visited"),
    ]
    if result.affected.any():
        touched = views.png(views.marked(image, result.affected))
        pictures.append(Figure(views.uri(touched), "orange: pixels that the trouble noted above touched"))
    sections = [
        Section("Picture", _fill_text(summary), figures=pictures, least="20rem", pixelated=True),
        Section(
            "Phase", _phase_text(result), axis_table(summary), phase_figures({result.motion.estimator: result}), "26rem"
        ),
        by_hand(result),
        Section(
            "Blur", BLUR_TEXT, figures=[blur_of({a: summary[a]["blur_px"] for a in AXES}, result.p)], least="30rem"
        ),
    ]
    return render(result.name, lead, sections, summary["notes"])


def comparison_report(
    title: str,
    lead: str,
    results: Mapping[str, Reconstruction],
    summaries: Mapping[str, Mapping[str, Any]],
    further: Sequence[Section] = (),
) -> str:
    """Several reconstructions of one recording side by side; pictures are held to the last, the reference.

    Args:
        further: sections to end with.
    """
    *estimated, reference = results
    first = results[estimated[0]]
    limits = views.contrast(results[reference].picture.image)
    pictures, enlarged = [], []
    for name, result in results.items():
        image = _upright(result)
        pictures.append(Figure(picture_uri(image, limits), caption(name, summaries[name])))
        enlarged.append(Figure(picture_uri(_middle(image), limits), f"{name}, the middle enlarged"))
    best = summaries[reference]["picture"]["rms"]
    columns = [[*_figures_of(summaries[name]), _picture_cell(summaries[name]["picture"], best)] for name in results]
    whats = ("phase error, rms,", "scan within ±p/m,", "error seen by the picture,")
    heads = [*(f"{what} {axis}" for axis in AXES for what in whats), "picture error"]
    rows = [[head, *cells] for head, *cells in zip(heads, *columns, strict=True)]
    blurs = {name: _both_axes(summaries[name]) for name in estimated}
    coverage = Figure(views.uri(views.png(views.coverage_image(first.picture.coverage))), COVERAGE_CAPTION)
    tracked = {name: results[name] for name in estimated}
    sections = [
        Section("One recording, one picture an estimator", figures=pictures, least="11rem", pixelated=True),
        Section("Enlarged", figures=enlarged, least="11rem", pixelated=True),
        Section("In figures", PICTURE_TEXT, Table(["", *results], rows)),
        Section("Phase", _phase_text(first), None, phase_figures(tracked), "26rem"),
        Section("Blur", BLUR_TEXT, figures=[blur_of(blurs, first.p)], least="30rem"),
        Section("Coverage", figures=[coverage], least="20rem", pixelated=True),
        *further,
    ]
    return render(title, lead, sections)


COVERAGE_CAPTION = "samples a pixel; blue: never visited (in the pictures filled from neighbours up to 2 pixels away)"
BLUR_TEXT = (
    "Displacement in pixels, rms over the scan, by cause; the causes add in quadrature to the total. The amplitude's "
    "uniform scale is magnification and is not counted."
)
PICTURE_TEXT = (
    "Phase errors against the truth of the simulation, rms over the whole scan. The picture's own word needs no truth: "
    "how far forward and backward sweeps lie apart. Picture error: rms against the noiseless scene over visited "
    "pixels, once a uniform magnification is taken out, and its ratio to that of the true motion."
)


def by_hand(result: Reconstruction) -> Section:
    """Sliders that add to the phases, for what chen2020 did by hand before its filter did it."""
    heading = "Phase by hand"
    data = sweeps(result)
    if data is None:
        return Section(heading, "The scan is too short for the phase sliders.")
    first, stop = (1e3 * seconds for seconds in data["seconds"])
    text = (
        f"The scan from {first:.4g} to {stop:.4g} ms, mapped again as the sliders move: forward sweeps in magenta, "
        "backward sweeps in green. A wrong phase moves them apart; where they agree the colours add up to grey, "
        "and that should be at the estimate, 0°. Arrow keys move by 0.01°."
    )
    return Section(heading, text, sweeps=data)


def axis_table(summary: Mapping[str, Any]) -> Table:
    """The axes' figures of a summary."""
    rows = [["phase, standard deviation [°]", *(f"{summary[a]['phase_sd_deg']:.4f}" for a in AXES)]]
    if all("phase_rmse_deg" in summary[a] for a in AXES):
        rows.append(["phase, true error rms [°]", *(f"{summary[a]['phase_rmse_deg']:.4f}" for a in AXES)])
    rows += [
        ["bound p/m [°]", *(f"{summary[a]['bound_deg']:.4f}" for a in AXES)],
        ["scan within the bound", *(f"{summary[a]['within_bound']:.1%}" for a in AXES)],
        ["phase error seen by the picture", *(_seen(summary[a]["picture_phase_error_deg"]) for a in AXES)],
        ["phase's drift over the scan [°]", *(f"{summary[a]['phase_drift_deg']:.3f}" for a in AXES)],
        ["amplitude [rad]", *(f"{summary[a]['amplitude_rad']:.5f}" for a in AXES)],
        ["frequency [Hz]", *(f"{summary[a]['frequency_hz']:.3f}" for a in AXES)],
        ["sign", *(summary[a]["sign"] for a in AXES)],
    ]
    return Table(["", *AXES], rows)


def phase_figures(results: Mapping[str, Reconstruction]) -> list[Figure]:
    """Phase against time, a figure an axis."""
    figures = []
    first = next(iter(results.values()))
    for axis in AXES:
        motions = {name: result.motion.axes[axis] for name, result in results.items()}
        errors = {name: result.errors[axis] for name, result in results.items() if axis in result.errors}
        seen = [(each.time, *getattr(each, axis)) for each in first.seen] if len(results) == 1 else []
        uri = views.phase_figure(motions, first.bound(axis), errors, seen, axis)
        figures.append(Figure(uri, f"phase of axis {axis}, ±2 sd; its error and the bound ±p/m"))
    return figures


def picture_uri(image: Any, limits: tuple[float, float] | None = None) -> str:
    """A picture as data URI."""
    return views.uri(views.png(views.coloured(image, limits)))


def blur_of(parts: Mapping[str, Mapping[str, float]], p: float) -> Figure:
    """Bars of blur by cause."""
    return Figure(views.blur_figure(parts, p), "blur by cause; dashed: the tolerated p")


def caption(name: str, summary: Mapping[str, Any]) -> str:
    """A picture's name with its phase errors."""
    if not all("phase_rmse_deg" in summary[a] for a in AXES):
        return name
    return f"{name}: phase error {summary['x']['phase_rmse_deg']:.2f}° in x, {summary['y']['phase_rmse_deg']:.2f}° in y"


def _fill_text(summary: Mapping[str, Any]) -> str:
    times = {fill: seconds for fill, seconds in summary["seconds_to_fill"].items() if seconds is not None}
    reached = ", ".join(f"{float(fill):.0%} after {1e3 * seconds:.3g} ms" for fill, seconds in times.items())
    return f"Pixels visited: {reached}." if reached else ""


def _phase_text(result: Reconstruction) -> str:
    bounds = ", ".join(f"{np.degrees(result.bound(a)):.3f}° in {a}" for a in AXES)
    return f"A phase error δφ moves a sample by up to m δφ pixels; p = {result.p:g} pixels allow {bounds}."


def _seen(value: Mapping[str, Any]) -> str:
    return (
        "nothing to tell"
        if value["value"] is None or value["sd"] is None
        else f"{value['value']:+.3f}° ± {value['sd']:.3f}°"
    )


def _figures_of(summary: Mapping[str, Any]) -> list[str]:
    cells = []
    for axis in AXES:
        own = summary[axis]
        cells += [f"{own['phase_rmse_deg']:.3f}°" if "phase_rmse_deg" in own else "", f"{own['within_bound']:.1%}"]
        cells.append(_seen(own["picture_phase_error_deg"]))
    return cells


def _both_axes(summary: Mapping[str, Any]) -> dict[str, float]:
    """Blur by cause, the two axes' displacements added in quadrature [px]."""
    return {
        cause: float(np.hypot(*(summary[axis]["blur_px"][cause] for axis in AXES))) for cause in summary["x"]["blur_px"]
    }


def _picture_cell(picture: Mapping[str, float], best: float) -> str:
    return f"{picture['rms']:.4f} ({picture['rms'] / best:.3f} ×)"


def _upright(result: Reconstruction) -> Any:
    flip_x, flip_y = mirrored(result)
    return views.visible(result.picture)[:: -1 if flip_y else 1, :: -1 if flip_x else 1]


def _middle(image: Any) -> Any:
    height, width = image.shape[:2]
    return image[3 * height // 8 : 5 * height // 8, 3 * width // 8 : 5 * width // 8]
