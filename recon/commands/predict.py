"""``lissajous predict REC``: play the recording's drive through a device, open loop, and compare."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", type=Path, help="the recording (.h5), or an instrument's file with --mapping")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder for the prediction")
    parser.add_argument("--mapping", type=Path, metavar="FILE", help="TOML: which variable is which channel")
    parser.add_argument("--device", type=Path, metavar="FILE", help="device TOML in place of the recording's own")


def run(args: argparse.Namespace) -> dict[str, Any]:
    from recon.predicting import predict_file

    return predict_file(args.recording, args.output, device=args.device, mapping=args.mapping)


def tell(summary: dict[str, Any]) -> str:
    lines = [f"{summary['output']}: {len(summary['channels'])} channels predicted from the first samples on"]
    for name, own in summary["channels"].items():
        line = f"  {name}: rmse {own['rmse']:.4g} {own['unit']}, {own['nrmse']:.3%} of the signal's deviation"
        if own["noise_sd"] is not None:
            line += f"; noise {own['noise_sd']:.4g} {own['unit']}"
        lines.append(line)
    return "\n".join(lines)
