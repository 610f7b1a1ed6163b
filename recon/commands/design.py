"""``lissajous design``: drive frequencies for a wanted field, resolution, frame rate and fill."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from recon.commands.reconstruct import size
from recon.commands.simulate import numbers, positive


def _pair(text: str) -> tuple[float, ...]:
    return numbers(text, 2, "30,30: of x and of y")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder for summary and report")
    parser.add_argument(
        "--device", default="imaging", metavar="NAME|FILE", help="a named device or a TOML file (imaging)"
    )
    parser.add_argument(
        "--half-angles", type=_pair, metavar="RAD,RAD", help="half the field in x and y (the device's [scan])"
    )
    parser.add_argument("--pixels", type=size, default=(400, 400), metavar="WxH", help="of the picture (400x400)")
    parser.add_argument("--frame-rate", type=positive, default=15.0, metavar="HZ", help="pictures a second (15)")
    parser.add_argument("--fill", type=positive, default=0.95, help="fraction of the pixels to visit (0.95)")
    parser.add_argument(
        "--volts", type=_pair, default=(30.0, 30.0), metavar="V,V", help="amplitude and offset of both drives (30,30)"
    )
    parser.add_argument(
        "--rate", type=positive, metavar="HZ", help="samples a second; without it the beam's whole path counts"
    )
    parser.add_argument(
        "--margin",
        type=float,
        default=0.0005,
        help="relative change of either stiffness that the field has to survive (0.0005)",
    )


def run(args: argparse.Namespace) -> dict[str, Any]:
    from phantoms.experiment import device_named
    from recon.designing import design_scan

    return design_scan(
        device_named(args.device),
        args.output,
        half_angles=args.half_angles,
        pixels=args.pixels,
        frame_rate=args.frame_rate,
        fill=args.fill,
        volts=args.volts,
        rate=args.rate,
        margin=args.margin,
    )


def tell(summary: dict[str, Any]) -> str:
    best, *others = summary["candidates"]
    drive = best["drive_hz"]
    lines = [
        f"{summary['output']}: drive x at {drive['x']:.4f} Hz and y at {drive['y']:.4f} Hz: {best['windings']['x']} : "
        f"{best['windings']['y']}, {best['frame_rate']:.4f} pictures a second",
        f"  fill {best['fill']['worst']:.1%} at the worst phase between the axes, {best['fill']['best']:.1%} at the "
        f"best; largest gap {best['gap_px']['worst']:.3g} and {best['gap_px']['best']:.3g} pixels",
        f"  the fill of {summary['wanted']['fill']:.1%} is reached: {best['fill_reached']}",
        *(f"  {note}" for note in summary["notes"]),
        f"  {len(others)} other pairs, report {summary['output']}/report.html",
    ]
    return "\n".join(lines)
