"""``lissajous point-cloud REC``: angles and ranges to points in space, with time, intensity and covariance."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from recon.cli.shared_arguments import add_source_arguments


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", type=Path, help="the recording (.h5), or an instrument's file with --mapping")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder for the points")
    parser.add_argument("--format", choices=("pcd", "las"), default="pcd", help="points.pcd or points.las (pcd)")
    add_source_arguments(parser)
    parser.add_argument("--estimator", metavar="NAME", help="tracker, ukf, ekf, ...; else by what was recorded")
    parser.add_argument("--flip-x", action="store_true", help="turn the sign of x")
    parser.add_argument("--flip-y", action="store_true", help="turn the sign of y")


def run(args: argparse.Namespace) -> dict[str, Any]:
    from recon.io.convert import open_any
    from recon.io.output import check_folder, finite, replacing_folder, write_json
    from recon.io.point_files import FORMATS, require_format, write_points
    from recon.point_cloud import make_point_cloud
    from recon.report.conclusions import conclude_point_cloud
    from recon.report.point_cloud import point_cloud_report
    from recon.steps.reconstruction import Options

    check_folder(args.output)
    require_format(args.format)
    flips = {"x": args.flip_x, "y": args.flip_y}
    options = Options(device=args.device, estimator=args.estimator, flips=flips)
    with open_any(args.recording, args.mapping) as recording:
        cloud = make_point_cloud(recording, options)
    points = f"points.{args.format}"
    summary: dict[str, Any] = finite(cloud.summary())
    summary["conclusion"] = conclude_point_cloud(summary, points)
    summary |= {"file": points, "recording": str(args.recording), "output": str(args.output)}
    of_formats = [f"points.{name}" for name in FORMATS]
    with replacing_folder(args.output, args.device, args.recording, optional=of_formats) as folder:
        write_points(folder / points, cloud, args.format)
        write_json(folder / "summary.json", summary)
        (folder / "report.html").write_text(point_cloud_report(cloud, summary), encoding="utf-8")
    return summary


def format_summary(summary: dict[str, Any]) -> str:
    lines = [summary["conclusion"], *(f"  {note}" for note in summary["notes"])]
    where = summary["output"]
    return "\n".join([*lines, f"  points {where}/{summary['file']}, report {where}/report.html"])
