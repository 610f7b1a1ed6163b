"""``lissajous design`` on files: a device in, summary and report out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from recon import views
from recon.coverage import fill_against_time
from recon.design import PHASES, Band, Candidate, Wish, design, gap_against_time
from recon.mapping import Grid, map_samples
from recon.output import check_folder, finite, replacing_folder, write_json
from recon.report import Figure, Section, Table, render
from scanner.device import Device

SHOWN = 3  # candidates in the plots against time
MOMENTS = 40  # at which the gap is taken


def design_scan(
    device: Device,
    output: Path,
    *,
    half_angles: tuple[float, float] | None,
    pixels: tuple[int, int],
    frame_rate: float,
    fill: float,
    volts: tuple[float, float],
    rate: float | None,
    margin: float,
) -> dict[str, Any]:
    """Find the pairs and write summary.json and report.html into ``output``; returns the summary.

    Args are those of ``recon.design.Wish`` and ``design``; ``half_angles`` None takes the device's field of view.

    Raises:
        BadInput: see ``recon.design.design``; a device without a field of view where none is given.
    """
    check_folder(output)
    if half_angles is None:
        view = device.require_scan()
        half_angles = view.half_angle_x, view.half_angle_y
    wish = Wish(Grid(*pixels, *half_angles), frame_rate, fill, rate, margin)
    bands, candidates = design(device, wish, volts)
    notes = _notes(candidates[0], wish)
    summary = finite(
        {
            "device": device.name,
            "wanted": {
                "half_angle_rad": dict(zip("xy", half_angles, strict=True)),
                "pixels": list(pixels),
                "frame_rate": frame_rate,
                "fill": fill,
                "sample_rate": rate,
                "volts": {"amplitude": volts[0], "offset": volts[1]},
                "margin": margin,
            },
            "bands": {name: _band_summary(band, wish) for name, band in bands.items()},
            "candidates": [_candidate_summary(each, fill) for each in candidates],
            "notes": notes,
            "output": str(output),
        }
    )
    with replacing_folder(output) as folder:
        write_json(folder / "summary.json", summary)
        page = _report(device.name, wish, bands, candidates, notes)
        (folder / "report.html").write_text(page, encoding="utf-8")
    return dict(summary)


def _half(wish: Wish, axis: str) -> float:
    return wish.grid.half_angle_x if axis == "x" else wish.grid.half_angle_y


def _band_summary(band: Band, wish: Wish) -> dict[str, Any]:
    low, high = band.covering(_half(wish, band.axis), wish.margin)
    return {
        "sustained_hz": [band.drive[0], band.drive[-1]],
        "covering_hz": [band.turns * low, band.turns * high],
        "largest_rad": band.amplitude.max(),
        "drive_over_motion": band.turns,
    }


def _candidate_summary(candidate: Candidate, fill: float) -> dict[str, Any]:
    figure = candidate.figure
    return {
        "drive_hz": dict(zip("xy", candidate.drive, strict=True)),
        "motion_hz": {a: n * figure.frame_rate for a, n in zip("xy", figure.windings, strict=True)},
        "windings": dict(zip("xy", figure.windings, strict=True)),
        "frame_rate": figure.frame_rate,
        "amplitude_rad": dict(zip("xy", figure.amplitude, strict=True)),
        "fill": dict(candidate.fill),
        "fill_reached": candidate.meets(fill),
        "fill_time_s": dict(candidate.time),
        "gap_px": dict(candidate.gap),
        "mesh_px": candidate.mesh,
        "phase_best_to_worst_deg": dict(zip("xy", np.degrees(figure.phase_room), strict=True)),
    }


def _notes(best: Candidate, wish: Wish) -> list[str]:
    notes = []
    reached = best.meets(wish.fill)
    if reached == "at the best phase":
        x, y = np.degrees(best.figure.phase_room)
        notes.append(
            f"the fill is reached at the best phase between the axes only; {x:.2g}° further in the phase of x, or "
            f"{y:.2g}° in that of y, lies the worst, and a drifting resonance moves through both"
        )
    if reached == "no":
        notes.append(f"no pair reaches a fill of {wish.fill:.1%}: ask for a lower frame rate or for fewer pixels")
    needed = best.figure.path_rate(wish.grid) / 2.0
    if wish.rate is not None and wish.rate < needed:
        notes.append(
            f"at {wish.rate:g} samples a second the beam skips pixels; from {needed:.3g} on it moves one at most"
        )
    return notes


def _report(
    name: str, wish: Wish, bands: Mapping[str, Band], candidates: Sequence[Candidate], notes: Sequence[str]
) -> str:
    grid, best = wish.grid, candidates[0]
    lead = (
        f"{grid.width} × {grid.height} pixels over {grid.half_angle_x:g} × {grid.half_angle_y:g} rad half angles, "
        f"{wish.frame_rate:g} pictures a second, a fill of {wish.fill:.1%} "
        + ("by the beam's path." if wish.rate is None else f"by {wish.rate:g} samples a second.")
    )
    coverage = []
    for phase in PHASES:
        x, y = best.figure.angles(_rate(best, wish), phase)
        picture = views.coverage_image(map_samples(x, y, x, grid).coverage)
        caption = f"{_named(best)} at the {phase} phase: samples a pixel; blue: never visited"
        coverage.append(Figure(views.uri(views.png(picture)), caption))
    growing = _against_time(candidates[:SHOWN], wish)
    sections = [
        Section("Pairs", PAIRS_TEXT, _table(candidates, wish)),
        Section("Fill and gap against time", TIME_TEXT, figures=[growing], least="30rem"),
        Section("One picture of the first pair", figures=coverage, least="20rem", pixelated=True),
        Section("Sustained motion", BAND_TEXT, figures=[_bands_figure(bands, wish, best)], least="30rem"),
    ]
    return render(f"Scan design: {name}", lead, sections, notes)


PAIRS_TEXT = (
    "Motions at n_x and n_y times the frame rate, without a common divisor, repeat as one figure. Its mesh is finest "
    "at the best phase between the axes and twice as coarse at the worst; a drifting resonance moves through both. "
    "Gap: diameter of the largest disc that holds no visited pixel."
)
TIME_TEXT = "One picture of each of the first pairs; lines: best phase, dashed: worst phase."
BAND_TEXT = (
    "Amplitude against the drive's frequency. Shaded: the field is covered, with the margin in stiffness. Below the "
    "curve's lower end the motion is lost: start above and come down."
)


def _rate(candidate: Candidate, wish: Wish) -> float:
    return wish.rate or candidate.figure.path_rate(wish.grid)


def _named(candidate: Candidate) -> str:
    n_x, n_y = candidate.figure.windings
    return f"{n_x} : {n_y}"


def _table(candidates: Sequence[Candidate], wish: Wish) -> Table:
    head = ["n_x : n_y", "drive x [Hz]", "drive y [Hz]", "pictures a second", "fill, worst", "fill, best"]
    head += ["gap, worst [px]", "gap, best [px]", "time to the fill, best [ms]", "fill reached"]
    rows = [
        [
            _named(each),
            *(f"{drive:.4f}" for drive in each.drive),
            f"{each.figure.frame_rate:.4f}",
            *(f"{each.fill[phase]:.1%}" for phase in reversed(PHASES)),
            *(f"{each.gap[phase]:.3g}" for phase in reversed(PHASES)),
            "–" if each.time["best"] is None else f"{1e3 * each.time['best']:.2f}",
            each.meets(wish.fill),
        ]
        for each in candidates
    ]
    return Table(head, rows)


def _against_time(candidates: Sequence[Candidate], wish: Wish) -> Figure:
    drawing, axes = views.figure(1, 2, (9.0, 3.2))
    left, right = axes[0]
    for candidate, colour in zip(candidates, views.COLOURS, strict=False):
        for phase, line in zip(PHASES, ("-", "--"), strict=True):
            rate = _rate(candidate, wish)
            x, y = candidate.figure.angles(rate, phase)
            time, fill = fill_against_time(x, y, rate, wish.grid)
            few = slice(None, None, max(1, time.size // 400))
            label = _named(candidate) if phase == "best" else None
            left.plot(1e3 * time[few], fill[few], line, color=colour, lw=1.2, label=label)
            moments = np.geomspace(0.02, 1.0, MOMENTS) * x.size / rate
            right.loglog(1e3 * moments, gap_against_time(x, y, rate, wish.grid, moments), line, color=colour, lw=1.2)
    left.axhline(wish.fill, color="#444", lw=0.8, ls=":")
    left.set(xlabel="time [ms]", ylabel="fill", ylim=(0.0, 1.02))
    left.legend(frameon=False, fontsize=8)
    right.set(xlabel="time [ms]", ylabel="largest gap [px]")
    return Figure(views.figure_uri(drawing), "fill factor and largest gap as one picture goes on")


def _bands_figure(bands: Mapping[str, Band], wish: Wish, best: Candidate) -> Figure:
    drawing, axes = views.figure(1, 2, (9.0, 3.0))
    for panel, band, drive in zip(axes[0], bands.values(), best.drive, strict=True):
        half = _half(wish, band.axis)
        low, high = band.covering(half, wish.margin)
        panel.axvspan(band.turns * low, band.turns * high, color="#3d8f5f", alpha=0.15, lw=0)
        panel.plot(band.drive, band.amplitude, color=views.COLOURS[0], lw=1.4)
        panel.axhline(half, color="#444", lw=0.8, ls="--")
        panel.axvline(drive, color=views.COLOURS[1], lw=1.0)
        panel.set(xlabel=f"drive of {band.axis} [Hz]", ylabel="amplitude [rad]", ylim=(0.0, None))
        panel.ticklabel_format(useOffset=False)
    return Figure(views.figure_uri(drawing), "sustained amplitude; dashed: half the field; red: the first pair's drive")
