"""``lissajous new-device``: a commented device file for a kind of scanner, filled with what is known."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from recon.cli.argument_types import parse_positive

KINDS = ("parametric", "electromagnetic", "piezo", "fibre", "afm", "galvo")
"""Keys of ``scanner.device_templates.KINDS``, which would take long to import."""

KNOWN = {
    "resonance": ("HZ", "resonance of {axis}"),
    "q": ("Q", "quality factor of {axis}"),
    "amplitude": ("RAD", "half the scanned range of {axis}, mechanical"),
    "drive-frequency": ("HZ", "frequency of the drive of {axis}; a parametric drive has twice the motion's"),
}
"""Options of each axis: placeholder and help."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="the device file to write")
    parser.add_argument("--kind", choices=KINDS, default="parametric", help="of the scanner (parametric)")
    parser.add_argument("--name", help="of the device (the kind)")
    parser.add_argument(
        "--frequencies-only",
        action="store_true",
        help="state only drive frequencies and field: phases then come from the picture",
    )
    for name, (metavar, text) in KNOWN.items():
        for axis in "xy":
            parser.add_argument(f"--{name}-{axis}", type=parse_positive, metavar=metavar, help=text.format(axis=axis))


def run(args: argparse.Namespace) -> dict[str, Any]:
    from scanner.device import Device
    from scanner.device_templates import KnownAxis, new_device
    from scanner.errors import BadInput
    from scanner.files import check_place

    check_place(args.output)
    if args.output.exists():
        raise BadInput("exists already", file=args.output, hint="name another with -o, or delete it first")
    known = {
        axis: KnownAxis(
            *(getattr(args, f"{name.replace('-', '_')}_{axis}") for name in KNOWN),
        )
        for axis in "xy"
    }
    text = new_device(args.kind, known, args.name, args.frequencies_only)
    device = Device.from_toml(text, source=str(args.output))
    args.output.write_text(text, encoding="utf-8")
    resonances = {name: axis.resonance for name, axis in device.axes.items() if axis.mechanics}
    return {"device": str(args.output), "name": device.name, "kind": args.kind, "resonance_hz": resonances}


def format_summary(summary: dict[str, Any]) -> str:
    resonances = ", ".join(f"{axis} {value:.6g} Hz" for axis, value in summary["resonance_hz"].items())
    return (
        f"{summary['device']}: {summary['kind']} scanner {summary['name']!r}"
        + (f", resonances {resonances}" if resonances else ", drive frequencies only")
        + "\n  replace the values marked typical; then give the file to other commands with --device"
    )
