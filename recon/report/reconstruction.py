"""The page of one reconstruction: pictures, phase, blur and the phase sliders."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.imaging.picture import Grid
from recon.imaging.sample_motion.correction import describe_sample_motion
from recon.io.output import pixel_size
from recon.report.conclusions import describe_stack
from recon.report.figures import (
    blur_figure,
    contrast_limits,
    coverage_to_rgb,
    coverage_white_level,
    data_uri,
    encode_png,
    highlight_pixels,
    phase_figure,
    sample_motion_figure,
    shown_image,
    to_rgb,
)
from recon.report.numbers import format_ends, format_uncertain
from recon.report.page import Figure, Section, Table, render
from recon.report.phase_slider import phase_slider_data
from recon.report.picture_conclusion import conclude_reconstruction
from recon.steps.reconstruction import Reconstruction
from scanner.device import AXES
from scanner.wording import quantity, sentence


def reconstruction_report(result: Reconstruction, summary: Mapping[str, Any], fill_radius: int = 0) -> str:
    """The page of one reconstruction; a segment of the intensity is part of it, for the phase sliders.

    Args:
        result, summary: of the reconstruction.
        fill_radius: holes of the picture are shown filled up to this many pixels; 0 fills none.
    """
    grid = result.picture.grid
    subject = (
        f"{summary['samples']} samples in {result.duration * 1e3:.4g} ms on {grid.width} × {grid.height} pixels, "
        f"{summary['fill']:.1%} of them visited. Estimator: {result.motion.estimator}; computed in "
        f"{result.seconds:.2f} s."
    )
    if summary["stack"]:
        stack = describe_stack(summary["stack"])
        subject += f" {stack[0].upper()}{stack[1:]}; the picture below is that of the whole scan."
    shown = shown_image(result.picture, fill_radius)
    image, limits = to_rgb(shown), contrast_limits(shown)
    filling = f"unvisited pixels within {fill_radius} px of a visited one filled" if fill_radius else "not filled"
    content = (
        f"picture, {filling}; blue: pixels never visited"
        if result.picture_kind == "mean"
        else f"{result.picture_kind} estimate of every pixel, also of those never visited"
    )
    bar, unit = scale_bar(grid), result.intensity.unit
    pictures = [
        Figure(
            data_uri(encode_png(image)),
            content,
            scale_bar=bar,
            grey_scale=format_ends(*limits, unit),
        ),
        *uncertainty_figures(result, bar),
        coverage_figure(result.picture.coverage, bar),
    ]
    if result.affected.any():
        highlighted = encode_png(highlight_pixels(image, result.affected))
        caption = "orange: pixels that the defects listed above affect"
        pictures.append(Figure(data_uri(highlighted), caption, scale_bar=bar))
    blur = blur_figure_of({axis: summary[axis]["blur_px"] for axis in AXES}, result.p)
    phases = phase_figures({result.motion.estimator: result})
    sections = [
        Section("Picture", _fill_text(summary), figures=pictures, least="20rem", pixelated=True),
        Section("Phase", _phase_text(result), axis_table(summary), phases, "26rem"),
        Section("Blur", BLUR_TEXT, figures=[blur], least="30rem"),
        *sample_motion_sections(result),
        phase_slider_section(result),
    ]
    return render(result.name, conclude_reconstruction(summary), sections, summary["notes"], subject)


BLUR_TEXT = (
    "Displacement of the samples in pixels, rms over the scan, by cause. The causes add in quadrature. A constant "
    "error of the amplitude changes the magnification only and is not counted."
)


def scale_bar(grid: Grid, part: float = 1.0) -> tuple[str, float]:
    """Label and length of a scale bar: a round length of about a quarter of the picture.

    Args:
        grid: of the picture.
        part: fraction of the picture's width that is shown.

    Returns:
        The label, and the length as a fraction of the shown width.
    """
    width, _, unit = pixel_size(grid)
    width, unit = (
        (width * grid.width * part, "µm") if unit == "um" else (1e3 * width * grid.width * part, f"mrad {grid.angle}")
    )
    return round_scale_bar(width, unit)


def round_scale_bar(width: float, unit: str) -> tuple[str, float]:
    """Label and length of a scale bar, as a fraction, for a picture of ``width`` in ``unit``.

    A quarter of the width that rounding moved below a round length counts as that length.
    """
    power = 10.0 ** math.floor(math.log10(width / 4.0))
    largest = width / 4.0 * (1.0 + 1e-9)
    length = max(step * power for step in (1.0, 2.0, 5.0, 10.0) if step * power <= largest)
    return f"{length:g} {unit}", length / width


def uncertainty_figures(result: Reconstruction, bar: tuple[str, float]) -> list[Figure]:
    """Standard deviation of each pixel, and the share of its own samples in its value; none where unknown."""
    figures = []
    if np.isfinite(result.picture_sd).any():
        limits = 0.0, contrast_limits(result.picture_sd)[1]
        image, unit = data_uri(encode_png(to_rgb(result.picture_sd, limits))), result.intensity.unit
        caption = "standard deviation of each pixel; blue: unknown"
        figures.append(Figure(image, caption, scale_bar=bar, grey_scale=("0", quantity(limits[1], unit, 3))))
    if result.data_share is not None:
        image = data_uri(encode_png(to_rgb(result.data_share, (0.0, 1.0))))
        caption = "share of a pixel's own samples in its value; black: the value follows from other pixels only"
        figures.append(Figure(image, caption, scale_bar=bar, grey_scale=("0", "1")))
    return figures


def coverage_figure(coverage: NDArray[Any], bar: tuple[str, float]) -> Figure:
    """Samples a pixel as a picture."""
    white = f"{coverage_white_level(coverage):.3g} samples a pixel"
    caption = "number of samples in each pixel; blue: never visited"
    return Figure(data_uri(encode_png(coverage_to_rgb(coverage))), caption, scale_bar=bar, grey_scale=("0", white))


def phase_slider_section(result: Reconstruction) -> Section:
    """Sliders that add to the phases, for the manual correction that chen2020 describes."""
    heading = "Phase by hand"
    data = phase_slider_data(result)
    if data is None:
        return Section(heading, "The scan is too short for the phase sliders.")
    first, stop = (1e3 * seconds for seconds in data["seconds"])
    text = (
        f"The scan from {first:.4g} to {stop:.4g} ms, mapped again when a slider moves: forward half-periods in "
        "magenta, backward half-periods in green. A wrong phase displaces them against each other; where they agree "
        "the sum is grey, which should be at the estimate, 0°. Arrow keys move by 0.01°."
    )
    return Section(heading, text, phase_slider=data)


def axis_table(summary: Mapping[str, Any]) -> Table:
    """Accuracy and motion of both axes."""
    rows = [["standard deviation of the phase [°]", *(f"{summary[a]['phase_sd_deg']:.2g}" for a in AXES)]]
    if all("phase_rmse_deg" in summary[a] for a in AXES):
        rows.append(["true phase error, rms [°]", *(f"{summary[a]['phase_rmse_deg']:.2g}" for a in AXES)])
    measured = (_format_picture_phase(summary[a]["picture_phase_error_deg"]) for a in AXES)
    contradictory = any(summary[a]["picture_phase_error_deg"]["scatter"] for a in AXES)
    scatter = (f"{summary[a]['picture_phase_error_deg']['scatter']:.2g}" for a in AXES)
    rows += [
        ["bound p/m [°]", *(f"{summary[a]['bound_deg']:.3f}" for a in AXES)],
        ["scan within the bound", *(f"{summary[a]['within_bound']:.1%}" for a in AXES)],
        ["phase error measured in the picture", *measured],
        *([["the same, difference between slices of the scan (1 sd) [°]", *scatter]] if contradictory else []),
        ["drift of the phase over the scan [°]", *(f"{summary[a]['phase_drift_deg']:.3g}" for a in AXES)],
        _amplitude_row(summary),
        [
            "standard deviation of the amplitude: scale of the picture",
            *(_format_amplitude_sd(summary[a]) for a in AXES),
        ],
        ["frequency [Hz]", *(_format_frequency(summary[a]["frequency_hz"]) for a in AXES)],
        ["sign of the angle", *(summary[a]["sign"] for a in AXES)],
    ]
    return Table(["", *AXES], rows)


def phase_figures(results: Mapping[str, Reconstruction]) -> list[Figure]:
    """Phase against time, a figure an axis."""
    figures = []
    first = next(iter(results.values()))
    for axis in AXES:
        motions = {name: result.motion.axes[axis] for name, result in results.items()}
        errors = {name: result.evaluation[axis] for name, result in results.items() if axis in result.evaluation}
        shown = [(e.time, *getattr(e, axis)) for e in first.phase_errors] if len(results) == 1 else []
        shown = [measured for measured in shown if np.isfinite(measured[2])]
        uri = phase_figure(motions, first.phase_bound(axis), errors, shown, axis)
        error = ", and its error with the bound ±p/m" if errors or shown else "; nothing shows its error"
        figures.append(Figure(uri, f"axis {axis}: phase with ±2 standard deviations{error}"))
    return figures


def sample_motion_sections(result: Reconstruction) -> list[Section]:
    """The motion of the sample that was removed; empty where none was."""
    motion = result.sample_motion
    if motion is None or not motion.moving:
        return []
    uri = sample_motion_figure(motion.times(result.intensity), motion.shift, motion.sd)
    figure = Figure(uri, "displacement of the sample with ±2 standard deviations; its mean is not determined")
    text = describe_sample_motion(motion, result.intensity.sample_rate)
    return [Section("Motion of the sample", sentence(text), figures=[figure], least="26rem")]


def blur_figure_of(parts: Mapping[str, Mapping[str, float]], p: float) -> Figure:
    """Bars of blur by cause."""
    return Figure(blur_figure(parts, p), "blur by cause; dashed: the tolerated p pixels")


def _amplitude_row(summary: Mapping[str, Any]) -> list[str]:
    """Amplitude of both axes, as a length where the device states the scale of the sample."""
    if all(summary[a]["amplitude_um"] is not None for a in AXES):
        return ["amplitude on the sample [µm]", *(f"{summary[a]['amplitude_um']:.4g}" for a in AXES)]
    return [f"amplitude [mrad {summary['angle']}]", *(f"{1e3 * summary[a]['amplitude_rad']:.2f}" for a in AXES)]


def _format_frequency(frequency: float | None) -> str:
    return "not determined" if frequency is None else f"{frequency:.3f}"


def _format_amplitude_sd(axis: Mapping[str, Any]) -> str:
    """Relative standard deviation of the amplitude, with the part from the calibration."""
    sd, calibration = axis["amplitude_sd_rad"], axis["amplitude_sd_calibration_rad"]
    if axis["amplitude_from"] == "field":
        return "not known: the half angle of [scan] is assumed, as the edges do not determine it"
    if sd is None:
        return "not known: nothing calibrates it"
    percent = 100.0 / axis["amplitude_rad"]
    if axis["amplitude_from"] == "edges":
        return f"{percent * sd:.2g} % (by the stated angle of the detector, taken as exact)"
    return f"{percent * sd:.2g} % (calibration {percent * calibration:.2g} %)"


def _fill_text(summary: Mapping[str, Any]) -> str:
    times = {fill: seconds for fill, seconds in summary["seconds_to_fill"].items() if seconds is not None}
    reached = ", ".join(f"{float(fill):.0%} after {1e3 * seconds:.3g} ms" for fill, seconds in times.items())
    return f"Pixels visited: {reached}." if reached else ""


def _phase_text(result: Reconstruction) -> str:
    bounds = ", ".join(f"{np.degrees(result.phase_bound(a)):.3f}° in {a}" for a in AXES)
    return (
        "A phase error δφ displaces a sample by up to m δφ pixels, where m is half the pixels across. A displacement "
        f"of p = {result.p:g} pixel allows {bounds}."
    )


def _format_picture_phase(value: Mapping[str, Any]) -> str:
    if value["value"] is None or value["sd"] is None:
        return "not determined"
    return format_uncertain(value["value"], value["sd"], "°")
