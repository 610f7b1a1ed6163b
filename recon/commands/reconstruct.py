"""``lissajous reconstruct REC...`` = ``reconstruct-from-recording REC...``: motion, picture, score, report."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from recon.commands.simulate import positive

if TYPE_CHECKING:
    from recon.pipeline import Options


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


def at_least_one(text: str) -> int:
    """A whole number above zero, for argparse."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number above 0")
    return int(text)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "recordings",
        type=Path,
        nargs="+",
        metavar="REC",
        help="the recording (.h5), or an instrument's file with --mapping; several at once go to a folder each",
    )
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="DIR", help="folder for pictures, motion, report"
    )
    several = parser.add_mutually_exclusive_group()
    several.add_argument("--scheduler", metavar="ADDRESS", help="several: on the Dask cluster of this scheduler")
    several.add_argument("--workers", type=at_least_one, metavar="N", help="several: processes here (one a core)")
    several.add_argument(
        "--follow", action="store_true", help="show the frames of a recording that is still being written, then all"
    )
    film = parser.add_mutually_exclusive_group()
    film.add_argument("--frames", type=at_least_one, metavar="N", help="write N frames of the scan to frames.ome.tif")
    film.add_argument(
        "--frame-time", type=positive, metavar="S", help="or frames of S seconds; follow: so long (the scan's repeat)"
    )
    parser.add_argument(
        "--quiet-time", type=positive, default=5.0, metavar="S", help="follow: end when nothing came for so long (5)"
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

    options = Options(
        device=args.device,
        estimator=args.estimator,
        pixels=args.pixels,
        p=args.p,
        flips={"x": args.flip_x, "y": args.flip_y},
        fill_radius=args.fill,
        spot=args.spot,
        frames=args.frames,
        frame_time=args.frame_time,
    )
    if len(args.recordings) > 1 or args.scheduler or args.workers:
        return _many(args, options)
    live = None
    if args.follow:
        from recon.follow import follow

        times = {"frame_time": args.frame_time, "quiet_time": args.quiet_time}
        live = follow(args.recordings[0], args.output, options, args.mapping, **times).summary()
    return reconstruct_file(args.recordings[0], args.output, options, args.mapping, live=live)


def _many(args: argparse.Namespace, options: Options) -> dict[str, Any]:
    from recon.batch import reconstruct_files
    from scanner.errors import BadInput

    if args.follow:
        raise BadInput("follows one recording", channel="--follow", hint="start one command for each")
    where = {"scheduler": args.scheduler, "workers": args.workers}
    return reconstruct_files(args.recordings, args.output, options, args.mapping, **where)


def tell(summary: dict[str, Any]) -> str:
    if "recordings" in summary:
        return _tell_many(summary)
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
    if "live" in summary:
        live = summary["live"]
        line = f"  live: {live['frames']} frames of {1e3 * (live['frame_s'] or 0.0):.4g} ms, {live['dropped']} dropped"
        if live["frames"]:
            line += f", {live['latency_s']['median']:.2f} s late (at most {live['latency_s']['max']:.2f} s)"
        lines.append(f"{line}; {live['ended']}")
    lines += [f"  {note}" for note in summary["notes"]]
    lines.append(f"  picture {summary['output']}/image.png, report {summary['output']}/report.html")
    return "\n".join(lines)


def _tell_many(summary: dict[str, Any]) -> str:
    rows = summary["recordings"]
    lines = [f"{summary['output']}: {len(rows) - summary['failed']} of {len(rows)} recordings reconstructed"]
    for each in rows:
        if each["failed"]:
            lines.append(f"  failed: {each['failed']}")
        else:
            held = ", ".join(f"{axis} {share:.1%}" for axis, share in each["within_bound"].items())
            lines.append(f"  {each['output']}: fill {each['fill']:.1%}, within the bound {held}")
    return "\n".join([*lines, f"  table {summary['output']}/summary.json, page {summary['output']}/index.html"])
