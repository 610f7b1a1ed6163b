"""``lissajous info FILE``: what a recording or an instrument's file holds, and a mapping to start from."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", type=Path, help="a recording, or an instrument's file")
    one = parser.add_mutually_exclusive_group()
    one.add_argument("--format", help="format, if it follows neither from the file's beginning nor from its name")
    one.add_argument("--mapping", type=Path, metavar="FILE", help="TOML: list the recording that it makes of the file")


def run(args: argparse.Namespace) -> dict[str, Any]:
    from recon.io.info import info

    return info(args.file, args.format, args.mapping)


def format_summary(summary: dict[str, Any]) -> str:
    lines = [f"{summary['file']}: {summary['format']}"]
    lines += [f"  {key}: {value}" for key, value in summary["about"].items()]
    for name, own in summary["variables"].items():
        size = " x ".join(map(str, own["shape"])) or "one value"
        line = f"  {name}: {size} {own['dtype']}, {own['unit'] or 'no unit stated'}"
        line += f", {own['sample_rate']:.9g} Hz" if own["sample_rate"] else ", no rate stated"
        line += f", from {own['start']:.9g} s" if own["start"] is not None else ""
        lines.append(line + (f" ({own['note']})" if own["note"] else ""))
    if summary["suggestion"]:
        lines += ["", summary["suggestion"]]
    return "\n".join(lines)
