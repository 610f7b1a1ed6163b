"""The report of ``point-cloud``: the points from the front and from above, their extent and standard deviation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from recon.point_cloud import PointCloud
from recon.report.figures import NARROW_WIDTH_IN, figure_uri, new_figure
from recon.report.numbers import format_value
from recon.report.page import Figure, Section, Table, render
from scanner.arrays import Array

MAX_DRAWN_POINTS = 20_000
"""Points of a figure, taken evenly from all: more do not show at its size."""

COLOUR_DECIMALS = 6
"""Decimals of the coloured lengths [m]: the colour bar of equal ranges would show the rounding of the arithmetic."""


def point_cloud_report(cloud: PointCloud, summary: Mapping[str, Any]) -> str:
    """The page; ``summary`` is the content of summary.json."""
    rows = [
        [name, *(f"{edge:.4g}" for edge in summary["extent_m"][name]), format_value(summary["sd_m"][name], 3)]
        for name in "xyz"
    ]
    part = np.linspace(0, cloud.time.size - 1, min(cloud.time.size, MAX_DRAWN_POINTS)).astype(int)
    x, y, z = cloud.position[part].T
    distance = np.linalg.norm(cloud.position[part], axis=1)
    figures = [
        Figure(draw_view(x, y, distance, "y [m]", "distance [m]"), "From the scanner; colour: distance."),
        Figure(draw_view(x, z, y, "z [m]", "y [m]"), "From above; colour: y."),
    ]
    head = ["axis", "smallest [m]", "largest [m]", "standard deviation, rms [m]"]
    counts = [
        ["shots", str(summary["shots"])],
        ["points", str(summary["points"])],
        ["without a return", str(summary["without_return"])],
        ["at unknown angles", str(summary["unlocated"])],
    ]
    sections = [
        Section("Points", "", Table(head, rows), figures, least="22rem"),
        Section("Shots", "", Table(["shots", "number"], counts)),
    ]
    subject = f"{summary['recording']}, {summary['estimator']}, geometry {summary['geometry']}."
    return render("Point cloud", summary["conclusion"], sections, summary["notes"], subject)


def draw_view(x: Array, up: Array, colour: Array, up_label: str, colour_label: str) -> str:
    """A scatter of points over x, coloured by a length, as the address of a picture; all lengths in metres."""
    drawing, axes = new_figure(1, 1, (NARROW_WIDTH_IN, 3.4))
    panel = axes[0, 0]
    colour = np.round(colour, COLOUR_DECIMALS)
    points = panel.scatter(x, up, s=1.0, c=colour, cmap="viridis", linewidths=0, rasterized=True)
    drawing.colorbar(points, ax=panel, label=colour_label)
    panel.set(xlabel="x [m]", ylabel=up_label)
    panel.set_aspect("equal", adjustable="datalim")
    return figure_uri(drawing)
