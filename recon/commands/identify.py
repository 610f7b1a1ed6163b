"""``lissajous identify REC...``: calibration recordings (rest, free decay, drive) -> the device."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recordings", type=Path, nargs="+", metavar="REC", help="calibration recordings (.h5)")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder for the device")
    parser.add_argument("--mapping", type=Path, metavar="FILE", help="TOML: which variable is which channel")
    parser.add_argument(
        "--device", type=Path, metavar="FILE", help="nominal device TOML in place of the recordings' own"
    )


def run(args: argparse.Namespace) -> dict[str, Any]:
    from recon.identifying import identify_files

    return identify_files(args.recordings, args.output, device=args.device, mapping=args.mapping)


def tell(summary: dict[str, Any]) -> str:
    lines = [f"{summary['output']}: {summary['device']} identified"]
    for name, axis in summary["axes"].items():
        lines.append(f"  {name}: {'; '.join(axis['used'])}")
        for key, value in axis["values"].items():
            low, high = value["ci95"]
            lines.append(f"    {key} = {value['value']:.6g} {value['unit']}, 95 %: {low:.6g} to {high:.6g}")
    return "\n".join([*lines, *(f"  {note}" for note in summary["notes"])])
