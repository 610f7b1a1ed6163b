"""Pages as sections of text, tables and figures: one HTML file that opens offline; all text is escaped."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from recon.report.figures import (
    UNVISITED,
)


@dataclass(frozen=True)
class Figure:
    """A picture in a data URI with its caption, which is also its text for screen readers.

    Attributes:
        uri: of the picture.
        caption: below it.
        page: address that the caption links to; none if empty.
        scale_bar: label of a scale bar and its length as a fraction of the picture's width; None for no bar.
        grey_scale: labels of black and of white; None for no bar.
    """

    uri: str
    caption: str
    page: str = ""
    scale_bar: tuple[str, float] | None = None
    grey_scale: tuple[str, str] | None = None


@dataclass(frozen=True)
class Table:
    """A table: a header, and rows whose first cell is the name of the row."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True)
class Section:
    """A heading with text, a table and figures.

    Attributes:
        heading, text, table, figures: in this order on the page.
        least: width below which figures no longer share a row (CSS).
        pixelated: show pixels as squares.
        phase_slider: data of the phase sliders, see :func:`recon.report.phase_slider.phase_slider_data`; in at most
            one section of a page.
    """

    heading: str
    text: str = ""
    table: Table | None = None
    figures: Sequence[Figure] = field(default_factory=tuple)
    least: str = "15rem"
    pixelated: bool = False
    phase_slider: Mapping[str, Any] | None = None


def render(
    title: str, conclusion: str, sections: Sequence[Section], notes: Sequence[str] = (), subject: str = ""
) -> str:
    """The page.

    Args:
        title: heading.
        conclusion: what was found and what to do about it, in a sentence or two with numbers and units.
        sections: the evidence.
        notes: limits and warnings, one line each.
        subject: what was measured or computed, in one line.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(loader=PackageLoader("recon.report"), autoescape=True, undefined=StrictUndefined)
    page = environment.get_template("report.html")
    return page.render(
        title=title, conclusion=conclusion, subject=subject, sections=sections, notes=notes, unvisited=UNVISITED
    )
