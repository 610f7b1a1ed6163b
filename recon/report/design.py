"""The report of ``design``: pairs of drive frequencies, their fill over time and the sustained motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from recon.imaging.coverage import fill_against_time, gap_against_time
from recon.imaging.gridding import map_samples
from recon.lissajous_figure import PHASES
from recon.report.figures import COLOURS, figure_uri, new_figure, use_plain_ticks
from recon.report.page import Figure, Section, Table, render
from recon.report.reconstruction import coverage_figure, scale_bar
from recon.scan_design import SKIPPING_STARTS, ScanCandidate, ScanRequirements, SustainedBand

SHOWN_CANDIDATES = 3
"""Candidates in the plots over time: six curves can be distinguished."""

GAP_TIMES = 40
"""Times at which the largest gap is computed; each needs a distance transform of the picture."""


def _half_angle(requirements: ScanRequirements, axis: str) -> float:
    return requirements.grid.half_angle_x if axis == "x" else requirements.grid.half_angle_y


def design_report(
    name: str,
    requirements: ScanRequirements,
    bands: Mapping[str, SustainedBand],
    candidates: Sequence[ScanCandidate],
    notes: Sequence[str],
    conclusion: str,
) -> str:
    """The page.

    Args:
        name: of the device.
        requirements: of the scan.
        bands: motion that the drives sustain, by axis.
        candidates: best first.
        notes: limits and warnings.
        conclusion: what to do, in a sentence.
    """
    grid, best = requirements.grid, candidates[0]
    half_x, half_y = grid.reported_half_angles
    subject = (
        f"Wanted: {grid.width} × {grid.height} pixels over {half_x:g} × {half_y:g} rad ({grid.angle} half "
        f"angles), {requirements.frame_rate:g} pictures a second, a fill of {requirements.fill:.1%} "
        + (
            "along the beam's path."
            if requirements.sample_rate is None
            else f"at {requirements.sample_rate:g} samples a second."
        )
    )
    coverage = []
    for phase in PHASES:
        x, y = best.figure.angles(_rate(best, requirements), *best.starts[phase])
        picture = map_samples(x, y, x, grid)
        shown = coverage_figure(picture.coverage, scale_bar(grid))
        caption = f"windings {_name(best)} at the {phase} phase between the axes: {shown.caption}"
        coverage.append(replace(shown, caption=caption))
    growing = _against_time(candidates[:SHOWN_CANDIDATES], requirements)
    sections = [
        Section("Pairs", PAIRS_TEXT, _table(candidates, requirements)),
        Section("Fill and gap over time", TIME_TEXT, figures=[growing], least="30rem"),
        Section("One picture of the first pair", figures=coverage, least="20rem", pixelated=True),
        Section("Sustained motion", BAND_TEXT, figures=[_bands_figure(bands, requirements, best)], least="30rem"),
    ]
    return render(f"Scan design: {name}", conclusion, sections, notes, subject)


PAIRS_TEXT = (
    "Motions at n_x and n_y times the frame rate, without a common divisor, repeat as one figure. Its mesh is finest "
    "at one phase between the axes and twice as coarse at another. The best phase is that of the two at which more "
    "pixels are visited, mostly that of the finest mesh. A drifting resonance passes through both. Where samples skip "
    "pixels, the fill depends on the instant of the first sample too: best and worst are then those of "
    f"{SKIPPING_STARTS} random phases and instants. "
    "Gap: diameter of the largest disc that contains no visited pixel."
)
TIME_TEXT = "During one picture of each of the first pairs. Solid: best phase between the axes; dashed: worst phase."
BAND_TEXT = (
    "Amplitude over the frequency of the drive. Shaded: the field is covered with the margin in stiffness. The motion "
    "stops below the lower end of the curve: start above it and decrease the frequency."
)


def _rate(candidate: ScanCandidate, requirements: ScanRequirements) -> float:
    return requirements.sample_rate or candidate.figure.path_rate(requirements.grid)


def _name(candidate: ScanCandidate) -> str:
    n_x, n_y = candidate.figure.windings
    return f"{n_x} : {n_y}"


def _table(candidates: Sequence[ScanCandidate], requirements: ScanRequirements) -> Table:
    head = ["n_x : n_y", "drive x [Hz]", "drive y [Hz]", "pictures a second", "fill, worst", "fill, best"]
    head += ["gap, worst [px]", "gap, best [px]", "time to the fill, best [ms]", "fill reached"]
    rows = [
        [
            _name(candidate),
            *(f"{drive:.4f}" for drive in candidate.drive),
            f"{candidate.figure.frame_rate:.4f}",
            *(f"{candidate.fill[phase]:.1%}" for phase in reversed(PHASES)),
            *(f"{candidate.gap[phase]:.3g}" for phase in reversed(PHASES)),
            "–" if candidate.time["best"] is None else f"{1e3 * candidate.time['best']:.2f}",
            candidate.fill_reached(requirements.fill),
        ]
        for candidate in candidates
    ]
    return Table(head, rows)


def _against_time(candidates: Sequence[ScanCandidate], requirements: ScanRequirements) -> Figure:
    drawing, axes = new_figure(1, 2, (9.0, 3.2))
    left, right = axes[0]
    for candidate, colour in zip(candidates, COLOURS, strict=False):
        for phase, line in zip(PHASES, ("-", "--"), strict=True):
            rate = _rate(candidate, requirements)
            x, y = candidate.figure.angles(rate, *candidate.starts[phase])
            time, fill = fill_against_time(x, y, rate, requirements.grid)
            few = slice(None, None, max(1, time.size // 400))
            label = _name(candidate) if phase == "best" else None
            left.plot(1e3 * time[few], fill[few], line, color=colour, lw=1.2, label=label)
            gap_times = np.geomspace(0.02, 1.0, GAP_TIMES) * x.size / rate
            right.loglog(
                1e3 * gap_times, gap_against_time(x, y, rate, requirements.grid, gap_times), line, color=colour, lw=1.2
            )
    left.axhline(requirements.fill, color="#444", lw=0.8, ls=":")
    left.set(xlabel="time [ms]", ylabel="visited pixels (fraction)", ylim=(0.0, 1.02))
    left.legend(frameon=False, fontsize=8)
    right.set(xlabel="time [ms]", ylabel="largest gap [px]")
    use_plain_ticks(right.xaxis)
    use_plain_ticks(right.yaxis)
    return Figure(figure_uri(drawing), "fraction of visited pixels and largest gap over time")


def _bands_figure(bands: Mapping[str, SustainedBand], requirements: ScanRequirements, best: ScanCandidate) -> Figure:
    drawing, axes = new_figure(1, 2, (9.0, 3.0))
    for panel, band, drive in zip(axes[0], bands.values(), best.drive, strict=True):
        half = _half_angle(requirements, band.axis)
        low, high = band.motion_frequencies_reaching(half, requirements.stiffness_margin)
        panel.axvspan(band.drive_per_motion * low, band.drive_per_motion * high, color="#3d8f5f", alpha=0.15, lw=0)
        scale = requirements.grid.angle_scale
        panel.plot(band.drive, scale * band.amplitude, color=COLOURS[0], lw=1.4)
        panel.axhline(scale * half, color="#444", lw=0.8, ls="--")
        panel.axvline(drive, color=COLOURS[1], lw=1.0)
        panel.set(
            xlabel=f"drive of {band.axis} [Hz]", ylabel=f"amplitude [rad {requirements.grid.angle}]", ylim=(0.0, None)
        )
        panel.ticklabel_format(useOffset=False)
    return Figure(figure_uri(drawing), "sustained amplitude; dashed: half the field; red: the first pair's drive")
