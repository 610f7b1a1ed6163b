"""Figures of reports as data URIs: pictures, coverage, phase over time, blur by cause."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from recon.evaluation import AxisEvaluation
from recon.imaging.picture import Picture, fill_holes
from scanner.arrays import Array
from scanner.motion import AxisMotion

if TYPE_CHECKING:
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure


UNVISITED = "#20405f"
"""Colour of pixels that the beam never visited; a picture has only greys."""

MARK_COLOUR = "#e08a1e"
"""Colour of pixels that a defect of the recording affects."""

FILL_RADIUS_PX = 2
"""Holes up to this radius are filled for display: at the usual fill they are isolated pixels."""

NARROW_WIDTH_IN = 4.6
"""Width of figures [inch] whose letters remain readable on the screen of a phone."""

MAX_CURVE_SEGMENTS = 2000
"""Segments of a drawn curve: more than a screen has columns."""

LEGEND: dict[str, Any] = {"frameon": False, "fontsize": 8, "loc": "lower left", "bbox_to_anchor": (0.0, 1.0)}
"""Legend above the panel, where it hides no curve."""

COLOURS = ("#2f6fb0", "#c8553d", "#3d8f5f", "#8a5fb0", "#b08a2f")
"""Colours of curves, in this order."""


def normalise_intensity(image: NDArray[Any], limits: tuple[float, float] | None = None) -> Array:
    """Scale values to [0, 1] between ``limits``, by default those of ``contrast_limits``; NaN remains NaN.

    If the picture has several detectors, their mean is used.
    """
    values = np.asarray(image if image.ndim == 2 else image.mean(-1), np.float64)
    low, high = limits or contrast_limits(image)
    return np.clip((values - low) / max(high - low, 1e-300), 0.0, 1.0)


def contrast_limits(image: NDArray[Any]) -> tuple[float, float]:
    """The 0.5 and 99.5 percentiles of the visited pixels; detectors are averaged."""
    low, high = np.nanpercentile(image if image.ndim == 2 else image.mean(-1), [0.5, 99.5])
    return float(low), float(high)


def to_rgb(image: NDArray[Any], limits: tuple[float, float] | None = None) -> NDArray[np.uint8]:
    """Grey picture as RGB, shape (height, width, 3); NaN has the colour ``UNVISITED``."""
    grey = normalise_intensity(image, limits)
    rgb = np.repeat((255 * np.nan_to_num(grey)).astype(np.uint8)[..., None], 3, axis=2)
    rgb[np.isnan(grey)] = _rgb(UNVISITED)
    return rgb


def _rgb(colour: str) -> NDArray[np.uint8]:
    """Red, green and blue of #rrggbb."""
    return np.frombuffer(bytes.fromhex(colour[1:]), np.uint8)


def highlight_pixels(rgb: NDArray[np.uint8], mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """A picture, shape (height, width, 3), with the pixels of ``mask`` mixed half and half with ``MARK_COLOUR``."""
    out = rgb.copy()
    out[mask] = (out[mask].astype(np.uint16) + _rgb(MARK_COLOUR)) // 2
    return out


def encode_png(image: NDArray[np.uint8]) -> bytes:
    """RGB or grey picture as PNG."""
    import cv2

    done, data = cv2.imencode(".png", image[..., ::-1] if image.ndim == 3 else image)
    if not done:
        raise OSError("a picture could not be encoded as PNG")
    return data.tobytes()


def fill_small_holes(picture: Picture) -> NDArray[np.float32]:
    """The picture for display: small holes are filled from their neighbours, wider ones remain NaN."""
    return fill_holes(picture, FILL_RADIUS_PX)[0]


def shown_image(picture: Picture, fill_radius: int) -> NDArray[np.float32]:
    """The picture for display: as measured, or with holes filled up to a radius above 0 [px]."""
    return fill_holes(picture, fill_radius)[0] if fill_radius else picture.image


def save_picture(path: Path, picture: Picture, affected: NDArray[np.bool_] | None = None, fill_radius: int = 0) -> None:
    """Write image.png, the picture for display; pixels never visited are blue unless filling is asked for.

    Args:
        path: the file.
        picture: to show.
        affected: pixels to highlight, shape (height, width).
        fill_radius: unvisited pixels within so many rows and columns of a visited one are filled; 0 fills none.
    """
    rgb = to_rgb(shown_image(picture, fill_radius))
    path.write_bytes(encode_png(rgb if affected is None else highlight_pixels(rgb, affected)))


def data_uri(data: bytes, kind: str = "image/png") -> str:
    """Data URI, which makes the page independent of other files."""
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def figure_uri(drawing: Figure) -> str:
    """A figure as SVG in a data URI; its text cannot become part of the page's HTML."""
    buffer = io.BytesIO()
    drawing.savefig(buffer, format="svg")
    return data_uri(buffer.getvalue(), "image/svg+xml")


def new_figure(rows: int = 1, columns: int = 1, size: tuple[float, float] = (7.0, 3.0)) -> tuple[Figure, Any]:
    """A figure in the style of the reports and its axes, shape (rows, columns); does without pyplot, a slow import."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}):
        drawing = Figure(figsize=size, layout="constrained")
        return drawing, drawing.subplots(rows, columns, squeeze=False)


def use_plain_ticks(axis: Axis) -> None:
    """Label a logarithmic axis with numbers such as 0.1, 1, 2, 5 in place of powers of ten."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    low, high = axis.get_view_interval()
    axis.set_major_locator(LogLocator(subs=(1.0,) if high / low > 1e3 else (1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def min_max_envelope(time: Array, values: Array) -> tuple[Array, Array]:
    """A curve; a long one as minimum and maximum of each of ``MAX_CURVE_SEGMENTS`` segments.

    This bounds the size of the page and keeps every outlier. A segment is NaN where all of its values are.
    """
    if time.size <= MAX_CURVE_SEGMENTS:
        return time, values
    edges = np.linspace(0, time.size, MAX_CURVE_SEGMENTS, endpoint=False).astype(np.int64)
    ends = np.fmin.reduceat(values, edges), np.fmax.reduceat(values, edges)
    return np.repeat(time[edges], 2), np.stack(ends, axis=1).ravel()


def phase_figure(
    motions: Mapping[str, AxisMotion],
    bound: float,
    errors: Mapping[str, AxisEvaluation],
    picture_errors: Sequence[tuple[float, float, float]] = (),
    name_of_axis: str = "the axis",
) -> str:
    """Phase of one axis over time with its ±2 sd band, and below it the phase error, if one is known.

    Args:
        motions: of the axis, by estimator.
        bound: p/m [rad].
        errors: against the truth, by estimator.
        picture_errors: (time, value, sd) of the phase error measured in the picture [s, rad, rad]; those whose sd is
            not finite are left out.
        name_of_axis: for the label.
    """
    known = [measurement for measurement in picture_errors if np.isfinite(measurement[2])]
    lower = bool(errors) or bool(known)
    drawing, axes = new_figure(2 if lower else 1, 1, (NARROW_WIDTH_IN, 4.4 if lower else 2.4))
    top = axes[0, 0]
    for (name, axis), colour in zip(motions.items(), COLOURS, strict=False):
        phase = np.degrees(axis.phase)
        phase = phase - 180.0 * np.round((phase[0] - np.degrees(next(iter(motions.values())).phase[0])) / 180.0)
        sd = np.degrees(axis.phase_sd)
        t, low = min_max_envelope(axis.time, phase - 2 * sd)
        top.fill_between(1e3 * t, low, min_max_envelope(axis.time, phase + 2 * sd)[1], color=colour, alpha=0.2, lw=0)
        t, phase = min_max_envelope(axis.time, phase)
        top.plot(1e3 * t, phase, color=colour, lw=1.2, label=name)
    top.set(ylabel=f"phase of {name_of_axis} [°]")
    top.legend(**LEGEND, ncols=2)
    if lower:
        bottom = axes[1, 0]
        bottom.sharex(top)
        largest = np.degrees(bound)
        bottom.axhspan(-largest, largest, color="#3d8f5f", alpha=0.15, lw=0, label="±p/m")
        for (name, error), colour in zip(errors.items(), COLOURS, strict=False):
            t, phase = min_max_envelope(error.time, np.degrees(error.phase))
            bottom.plot(1e3 * t, phase, color=colour, lw=1.0, label=f"{name}: true error")
        if known:
            t, value, sd = (np.array(column) for column in zip(*known, strict=True))
            bottom.errorbar(
                1e3 * t,
                np.degrees(value),
                2 * np.degrees(sd),
                fmt="o",
                ms=3,
                color="#444",
                label="measured in the picture",
            )
        bottom.set(ylabel="phase error [°]")
        bottom.legend(**LEGEND, ncols=2)
    axes[-1, 0].set_xlabel("time [ms]")
    return figure_uri(drawing)


def sample_motion_figure(time: Array, shift: Array, sd: Array) -> str:
    """Displacement of the sample in x and y over time with its ±2 sd band.

    Args:
        time: shape (n,) [s].
        shift, sd: shape (n, 2) [px].
    """
    drawing, axes = new_figure(size=(NARROW_WIDTH_IN, 2.4))
    panel = axes[0, 0]
    for name, values, spread, colour in zip("xy", shift.T, sd.T, COLOURS, strict=False):
        at, low = min_max_envelope(time, values - 2 * spread)
        high = min_max_envelope(time, values + 2 * spread)[1]
        panel.fill_between(1e3 * at, low, high, color=colour, alpha=0.2, lw=0)
        at, middle = min_max_envelope(time, values)
        panel.plot(1e3 * at, middle, color=colour, lw=1.2, label=name)
    panel.set(xlabel="time [ms]", ylabel="displacement [px]")
    panel.legend(**LEGEND, ncols=2)
    return figure_uri(drawing)


def blur_figure(parts: Mapping[str, Mapping[str, float]], p: float) -> str:
    """Blur by cause [px], one group of bars a cause with one bar for each entry of ``parts``, and the tolerated p."""
    drawing, axes = new_figure(size=(NARROW_WIDTH_IN, 2.8))
    panel = axes[0, 0]
    causes = list(next(iter(parts.values())))
    height = 0.8 / len(parts)
    for i, ((name, values), colour) in enumerate(zip(parts.items(), COLOURS, strict=False)):
        rows = np.arange(len(causes)) + (i - (len(parts) - 1) / 2) * height
        panel.barh(rows, list(values.values()), height, color=colour, label=name)
    panel.axvline(p, color="#444", lw=0.8, ls="--")
    panel.text(p, 1.0, "p", ha="center", va="bottom", transform=panel.get_xaxis_transform())
    panel.set(yticks=np.arange(len(causes)), yticklabels=causes, xlabel="blur, rms [px]")
    panel.invert_yaxis()
    panel.legend(frameon=False, fontsize=8)
    return figure_uri(drawing)


def coverage_white_level(coverage: NDArray[Any]) -> float:
    """Samples a pixel that :func:`coverage_to_rgb` shows as white: the 99th percentile of the visited pixels."""
    return float(np.percentile(coverage[coverage > 0], 99)) if (coverage > 0).any() else 1.0


def coverage_to_rgb(coverage: NDArray[Any]) -> NDArray[np.uint8]:
    """Samples a pixel as a picture, shape (height, width, 3); pixels without samples have the colour ``UNVISITED``."""
    counts = np.where(coverage > 0, coverage, np.nan).astype(np.float64)
    return to_rgb(counts, (0.0, coverage_white_level(coverage)))
