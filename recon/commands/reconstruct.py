"""``lissajous reconstruct REC`` = ``reconstruct-from-recording REC``: motion, picture, score, report."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from recon.commands.simulate import positive


def size(text: str) -> tuple[int, int]:
    """WIDTHxHEIGHT, for argparse."""
    width, cross, height = text.lower().partition("x")
    if (
        not cross
        or not width.isdecimal()
        or not height.isdecimal()
        or not (1 <= int(width) <= 16384 >= int(height) >= 1)
    ):
        raise argparse.ArgumentTypeError(f"{text!r} is no size; give WIDTHxHEIGHT, as 400x400")
    return int(width), int(height)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", type=Path, help="the recording (.h5), or an instrument's file with --mapping")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="DIR", help="folder for pictures, motion, report"
    )
    parser.add_argument("--mapping", type=Path, metavar="FILE", help="TOML: which variable is which channel")
    parser.add_argument("--device", type=Path, metavar="FILE", help="device TOML in place of the recording's own")
    parser.add_argument("--estimator", metavar="NAME", help="tracker, ukf, ekf, ...; else by what was recorded")
    parser.add_argument("--pixels", type=size, default=(400, 400), metavar="WxH", help="size of the picture (400x400)")
    parser.add_argument("--p", type=positive, default=1.0, help="pixels of shift that are tolerated (1)")
    parser.add_argument(
        "--flip-x", action="store_true", help="turn the sign of x, which an even capacitance cannot know"
    )
    parser.add_argument("--flip-y", action="store_true", help="turn the sign of y")
    parser.add_argument(
        "--fill",
        type=int,
        default=0,
        metavar="PX",
        help="fill holes up to PX pixels wide, marked in fill.tif (0: none)",
    )
    parser.add_argument(
        "--spot", type=positive, metavar="PX", help="sd of the beam's spot in pixels, for the blur's account"
    )
    parser.add_argument("--seed", type=int, default=0, help="of whatever is drawn at random (nothing is, at present)")


def run(args: argparse.Namespace) -> dict[str, Any]:
    from recon.pipeline import Options
    from recon.reconstructing import reconstruct_file

    return reconstruct_file(
        args.recording,
        args.output,
        Options(
            device=args.device,
            estimator=args.estimator,
            pixels=args.pixels,
            p=args.p,
            flips={"x": args.flip_x, "y": args.flip_y},
            fill_radius=args.fill,
            spot=args.spot,
        ),
        args.mapping,
    )


def tell(summary: dict[str, Any]) -> str:
    lines = [f"{summary['output']}: {summary['estimator']}, {summary['samples']} samples, fill {summary['fill']:.1%}"]
    for axis in summary["axes"]:
        own = summary[axis]
        line = f"  {axis}: phase ±{own['phase_sd_deg']:.3f}° (1 sd)"
        line += f", bound {own['bound_deg']:.3f}° held {own['within_bound']:.1%}"
        if "phase_rmse_deg" in own:
            line += f", true error {own['phase_rmse_deg']:.3f}° rms"
        seen = own["picture_phase_error_deg"]
        if seen["sd"] is not None:
            line += f", the picture shows {seen['value']:+.3f}° ± {seen['sd']:.3f}°"
        lines.append(f"{line}; sign {own['sign']}")
    lines.append(f"  picture {summary['output']}/image.png, report {summary['output']}/report.html")
    return "\n".join(lines)
