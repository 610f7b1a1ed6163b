"""Pictures for people: the reconstruction, its coverage, phase against time, blur by cause. Each becomes a data URI."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from recon.mapping import Picture, fill_holes
from recon.score import AxisError
from scanner.motion import AxisMotion

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

UNVISITED = "#20405f"  # pixels the beam never reached; no grey of a picture
MARK = "#e08a1e"  # pixels that a stretch of trouble touched
FILL_FOR_THE_EYE = 2  # pixels
NARROW = 4.6  # in: on a phone's screen its letters can be read still
SHOWN = 2000  # stretches of a curve: more than a screen has columns
LEGEND: dict[str, Any] = {"frameon": False, "fontsize": 8, "loc": "lower left", "bbox_to_anchor": (0.0, 1.0)}
COLOURS = ("#2f6fb0", "#c8553d", "#3d8f5f", "#8a5fb0", "#b08a2f")


def stretched(image: NDArray[Any], limits: tuple[float, float] | None = None) -> Array:
    """Values in [0, 1] between the 0.5 and 99.5 percentiles, or ``limits``; NaN stays, detectors are averaged."""
    values = np.asarray(image if image.ndim == 2 else image.mean(-1), np.float64)
    low, high = limits or contrast(image)
    return np.clip((values - low) / max(high - low, 1e-300), 0.0, 1.0)


def contrast(image: NDArray[Any]) -> tuple[float, float]:
    """The 0.5 and 99.5 percentiles of the visited pixels; detectors are averaged."""
    low, high = np.nanpercentile(image if image.ndim == 2 else image.mean(-1), [0.5, 99.5])
    return float(low), float(high)


def coloured(image: NDArray[Any], limits: tuple[float, float] | None = None) -> NDArray[np.uint8]:
    """Grey picture as RGB, shape (H, W, 3), with ``UNVISITED`` where there is no value."""
    grey = stretched(image, limits)
    rgb = np.repeat((255 * np.nan_to_num(grey)).astype(np.uint8)[..., None], 3, axis=2)
    rgb[np.isnan(grey)] = _rgb(UNVISITED)
    return rgb


def _rgb(colour: str) -> NDArray[np.uint8]:
    """Of #rrggbb."""
    return np.frombuffer(bytes.fromhex(colour[1:]), np.uint8)


def marked(rgb: NDArray[np.uint8], mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """A picture, shape (H, W, 3), with the pixels of ``mask``, shape (H, W), halfway to ``MARK``."""
    out = rgb.copy()
    out[mask] = (out[mask].astype(np.uint16) + _rgb(MARK)) // 2
    return out


def png(image: NDArray[np.uint8]) -> bytes:
    """RGB or grey picture as PNG."""
    import cv2

    done, data = cv2.imencode(".png", image[..., ::-1] if image.ndim == 3 else image)
    if not done:
        raise OSError("a picture could not be encoded as PNG")
    return data.tobytes()


def visible(picture: Picture) -> NDArray[np.float32]:
    """A picture for the eye: holes of a pixel or two filled from their neighbours; wider ones stay NaN."""
    return fill_holes(picture, FILL_FOR_THE_EYE)[0]


def save_picture(path: Path, picture: Picture, affected: NDArray[np.bool_] | None = None) -> None:
    """image.png: the picture for the eye; what was measured, and where, stands in image.tif and coverage.tif.

    Args:
        affected: pixels to mark, shape (height, width).
    """
    rgb = coloured(visible(picture))
    path.write_bytes(png(rgb if affected is None else marked(rgb, affected)))


def uri(data: bytes, kind: str = "image/png") -> str:
    """Data URI, so that the page needs no other file."""
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def figure_uri(drawing: Figure) -> str:
    """A figure as SVG in a data URI; text in it cannot reach the page."""
    buffer = io.BytesIO()
    drawing.savefig(buffer, format="svg")
    return uri(buffer.getvalue(), "image/svg+xml")


def figure(rows: int = 1, columns: int = 1, size: tuple[float, float] = (7.0, 3.0)) -> tuple[Figure, Any]:
    """A figure in the house's style. It is made without pyplot, which would cost a second to import."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}):
        drawing = Figure(figsize=size, layout="constrained")
        return drawing, drawing.subplots(rows, columns, squeeze=False)


def thinned(time: Array, values: Array) -> tuple[Array, Array]:
    """A curve as it is, or where it has more than SHOWN points the least and the largest of each of as many stretches.

    A page on a long recording stays as light as one on a short one, and no outlier is lost.
    """
    if time.size <= SHOWN:
        return time, values
    edges = np.linspace(0, time.size, SHOWN, endpoint=False).astype(np.int64)
    ends = np.minimum.reduceat(values, edges), np.maximum.reduceat(values, edges)
    return np.repeat(time[edges], 2), np.stack(ends, axis=1).ravel()


def phase_figure(
    motions: Mapping[str, AxisMotion],
    bound: float,
    errors: Mapping[str, AxisError],
    seen: Sequence[tuple[float, float, float]] = (),
    name_of_axis: str = "the axis",
) -> str:
    """Phase of one axis against time with its ±2 sd band, and below, where truth or picture tell one, its error.

    Args:
        motions: of the axis, by the name to show. bound: p/m [rad]. errors: by the same names.
        seen: (time, value, sd) of the phase error that the picture shows [s, rad, rad].
    """
    lower = bool(errors) or bool(seen)
    drawing, axes = figure(2 if lower else 1, 1, (NARROW, 4.4 if lower else 2.4))
    top = axes[0, 0]
    for (name, axis), colour in zip(motions.items(), COLOURS, strict=False):
        phase = np.degrees(axis.phase)
        phase = phase - 180.0 * np.round((phase[0] - np.degrees(next(iter(motions.values())).phase[0])) / 180.0)
        sd = np.degrees(axis.phase_sd)
        t, low = thinned(axis.time, phase - 2 * sd)
        top.fill_between(1e3 * t, low, thinned(axis.time, phase + 2 * sd)[1], color=colour, alpha=0.2, lw=0)
        t, phase = thinned(axis.time, phase)
        top.plot(1e3 * t, phase, color=colour, lw=1.2, label=name)
    top.set(ylabel=f"phase of {name_of_axis} [°]")
    top.legend(**LEGEND, ncols=2)
    if lower:
        bottom = axes[1, 0]
        largest = np.degrees(bound)
        bottom.axhspan(-largest, largest, color="#3d8f5f", alpha=0.15, lw=0, label="±p/m")
        for (name, error), colour in zip(errors.items(), COLOURS, strict=False):
            t, phase = thinned(error.time, np.degrees(error.phase))
            bottom.plot(1e3 * t, phase, color=colour, lw=1.0, label=f"{name}: true error")
        told = [each for each in seen if np.isfinite(each[2])]
        if told:
            t, value, sd = (np.array(column) for column in zip(*told, strict=True))
            bottom.errorbar(
                1e3 * t, np.degrees(value), 2 * np.degrees(sd), fmt="o", ms=3, color="#444", label="seen in the picture"
            )
        bottom.set(ylabel="phase error [°]")
        bottom.legend(**LEGEND, ncols=2)
    axes[-1, 0].set_xlabel("time [ms]")
    return figure_uri(drawing)


def blur_figure(parts: Mapping[str, Mapping[str, float]], p: float) -> str:
    """Blur by cause [px], a group of bars for each entry of ``parts``, with the tolerated p."""
    drawing, axes = figure(size=(NARROW, 2.4))
    own = axes[0, 0]
    causes = list(next(iter(parts.values())))
    width = 0.8 / len(parts)
    for i, ((name, values), colour) in enumerate(zip(parts.items(), COLOURS, strict=False)):
        own.bar(
            np.arange(len(causes)) + (i - (len(parts) - 1) / 2) * width,
            list(values.values()),
            width,
            color=colour,
            label=name,
        )
    own.axhline(p, color="#444", lw=0.8, ls="--")
    own.text(len(causes) - 0.5, p, " p", va="center")
    own.set(xticks=np.arange(len(causes)), xticklabels=causes, ylabel="blur, rms [px]")
    own.legend(frameon=False, fontsize=8)
    return figure_uri(drawing)


def coverage_image(coverage: NDArray[Any]) -> NDArray[np.uint8]:
    """Samples a pixel as a picture: white is the 99th percentile and above, ``UNVISITED`` where there are none."""
    counts = np.where(coverage > 0, coverage, np.nan).astype(np.float64)
    return coloured(counts, (0.0, float(np.nanpercentile(counts, 99))))
