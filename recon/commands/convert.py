"""``lissajous convert FILE``: an instrument's file becomes a recording."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", type=Path, help="the instrument's file")
    parser.add_argument(
        "--mapping", type=Path, required=True, help="TOML: which variable is which channel, unit, rate, device"
    )
    parser.add_argument("-o", "--output", type=Path, required=True, help="the recording to write (.h5)")


def run(args: argparse.Namespace) -> dict[str, Any]:
    from recon.convert import convert_file

    return convert_file(args.file, args.mapping, args.output)


def tell(summary: dict[str, Any]) -> str:
    channels = ", ".join(
        f"{name} [{channel['unit']}] at {channel['sample_rate']:g} Hz" for name, channel in summary["channels"].items()
    )
    return f"{summary['recording']}: {summary['duration']:.6g} s of {channels}"
