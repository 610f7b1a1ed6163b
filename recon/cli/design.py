"""``lissajous design``: drive frequencies for a given field, resolution, frame rate and fill factor."""

from __future__ import annotations

import argparse
from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING, Any

from recon.cli.argument_types import parse_axis_pair, parse_not_negative, parse_positive, parse_size

if TYPE_CHECKING:
    from recon.scan_design import ScanCandidate, ScanRequirements, SustainedBand
    from scanner.device import Device


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder for summary and report")
    parser.add_argument(
        "--device", default="imaging", metavar="NAME|FILE", help="a named device or a TOML file (imaging)"
    )
    parser.add_argument(
        "--half-angles", type=parse_axis_pair, metavar="RAD,RAD", help="half the field in x and y (the device's [scan])"
    )
    parser.add_argument("--pixels", type=parse_size, default=(400, 400), metavar="WxH", help="of the picture (400x400)")
    parser.add_argument("--frame-rate", type=parse_positive, default=15.0, metavar="HZ", help="pictures a second (15)")
    parser.add_argument("--fill", type=parse_positive, default=0.95, help="fraction of the pixels to visit (0.95)")
    parser.add_argument(
        "--volts",
        type=parse_axis_pair,
        default=(30.0, 30.0),
        metavar="V,V",
        help="amplitude and offset of both drives (30,30)",
    )
    counted = parser.add_mutually_exclusive_group()
    counted.add_argument(
        "--rate", type=parse_positive, default=5e6, metavar="HZ", help="samples a second, which fill pixels (5e6)"
    )
    counted.add_argument(
        "--beam-path", action="store_true", help="count every pixel on the beam's path, not only those with a sample"
    )
    parser.add_argument(
        "--margin",
        type=parse_not_negative,
        default=0.0005,
        help="relative change of either stiffness that the field has to survive (0.0005)",
    )


def run(args: argparse.Namespace) -> dict[str, Any]:
    from scanner.devices import find

    return design_scan(
        find(args.device),
        args.output,
        half_angles=args.half_angles,
        pixels=args.pixels,
        frame_rate=args.frame_rate,
        fill=args.fill,
        volts=args.volts,
        rate=None if args.beam_path else args.rate,
        margin=args.margin,
    )


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
    """Find pairs of drive frequencies; write summary.json and report.html into ``output``; return the summary.

    Args:
        half_angles: half the field in x and y [rad]; None takes the device's field of view.
        pixels, frame_rate, fill, volts, rate, margin: as in ``recon.scan_design.ScanRequirements`` and ``design``.

    Raises:
        BadInput: as ``recon.scan_design.design``, or neither a field nor the device's field of view is given.
    """
    from recon.imaging.picture import grid_of_scan
    from recon.io.output import check_folder, finite, replacing_folder, write_json
    from recon.report.conclusions import conclude_design
    from recon.report.design import design_report
    from recon.scan_design import ScanRequirements, design, wanted_field

    check_folder(output)
    grid = grid_of_scan(*pixels, wanted_field(device, half_angles))
    requirements = ScanRequirements(grid, frame_rate, fill, rate, margin)
    bands, candidates = design(device, requirements, volts)
    notes = _design_notes(candidates[0], requirements)
    summary = finite(
        {
            "device": device.name,
            "wanted": {
                "half_angle_rad": dict(zip("xy", grid.reported_half_angles, strict=True)),
                "angle": grid.angle,
                "pixels": list(pixels),
                "frame_rate": frame_rate,
                "fill": fill,
                "sample_rate": rate,
                "volts": {"amplitude": volts[0], "offset": volts[1]},
                "margin": margin,
            },
            "bands": {name: _band_summary(band, requirements) for name, band in bands.items()},
            "candidates": [_candidate_summary(candidate, requirements) for candidate in candidates],
            "notes": notes,
            "output": str(output),
        }
    )
    summary["conclusion"] = conclude_design(summary)
    with replacing_folder(output) as folder:
        write_json(folder / "summary.json", summary)
        page = design_report(device.name, requirements, bands, candidates, notes, summary["conclusion"])
        (folder / "report.html").write_text(page, encoding="utf-8")
    return dict(summary)


def _band_summary(band: SustainedBand, requirements: ScanRequirements) -> dict[str, Any]:
    grid = requirements.grid
    half_angle = grid.half_angle_x if band.axis == "x" else grid.half_angle_y
    low, high = band.motion_frequencies_reaching(half_angle, requirements.stiffness_margin)
    return {
        "sustained_hz": [band.drive[0], band.drive[-1]],
        "covering_hz": [band.drive_per_motion * low, band.drive_per_motion * high],
        "largest_rad": grid.angle_scale * band.amplitude.max(),
        "drive_over_motion": band.drive_per_motion,
    }


def _candidate_summary(candidate: ScanCandidate, requirements: ScanRequirements) -> dict[str, Any]:
    figure, scale = candidate.figure, requirements.grid.angle_scale
    return {
        "drive_hz": dict(zip("xy", candidate.drive, strict=True)),
        "motion_hz": {a: n * figure.frame_rate for a, n in zip("xy", figure.windings, strict=True)},
        "windings": dict(zip("xy", figure.windings, strict=True)),
        "frame_rate": figure.frame_rate,
        "amplitude_rad": {a: scale * amplitude for a, amplitude in zip("xy", figure.amplitude, strict=True)},
        "fill": dict(candidate.fill),
        "fill_reached": candidate.fill_reached(requirements.fill),
        "fill_time_s": dict(candidate.time),
        "gap_px": dict(candidate.gap),
        "mesh_px": candidate.mesh_diameter,
        "phase_best_to_worst_deg": {a: degrees(room) for a, room in zip("xy", figure.phase_best_to_worst, strict=True)},
    }


def _design_notes(best: ScanCandidate, requirements: ScanRequirements) -> list[str]:
    from recon.scan_design import SKIPPING_STARTS

    notes = []
    reached, grid, rate = best.fill_reached(requirements.fill), requirements.grid, requirements.sample_rate
    skips = rate is not None and best.figure.skips_pixels(rate, grid)
    if reached == "at the best phase" and not skips:
        x, y = map(degrees, best.figure.phase_best_to_worst)
        notes.append(
            f"the fill is reached at the best phase between the axes only; {x:.2g}° further in the phase of x, or "
            f"{y:.2g}° in that of y, lies the worst, and a drifting resonance moves through both"
        )
    if reached == "no":
        notes.append(f"no pair reaches a fill of {requirements.fill:.1%}: choose a lower frame rate or fewer pixels")
    if skips:
        notes.append(
            f"at {rate:g} samples a second the beam skips pixels, and the fill depends on the instant of the first "
            f"sample too (best and worst of {SKIPPING_STARTS} pictures at random phases); from "
            f"{best.figure.path_rate(grid) / 2.0:.3g} on it moves one at most"
        )
    return notes


def format_summary(summary: dict[str, Any]) -> str:
    best, *others = summary["candidates"]
    drive = best["drive_hz"]
    lines = [
        summary["conclusion"],
        f"{summary['output']}: drive x at {drive['x']:.4f} Hz and y at {drive['y']:.4f} Hz: {best['windings']['x']} : "
        f"{best['windings']['y']}, {best['frame_rate']:.4f} pictures a second",
        f"  fill {best['fill']['worst']:.1%} at the worst phase between the axes, {best['fill']['best']:.1%} at the "
        f"best; largest gap {best['gap_px']['worst']:.3g} and {best['gap_px']['best']:.3g} pixels",
        f"  the fill of {summary['wanted']['fill']:.1%} is reached: {best['fill_reached']}",
        *(f"  {note}" for note in summary["notes"]),
        f"  {len(others)} other pairs, report {summary['output']}/report.html",
    ]
    return "\n".join(lines)
