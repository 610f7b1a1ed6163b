"""``lissajous convert FILE``: an instrument's file becomes a recording."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from scanner.wording import counted

# What may be said of channels in arguments: option -> key of the mapping, and what its value is.
OPTIONS = {
    "unit": ("unit", str),
    "rate": ("sample_rate", float),
    "start": ("start", float),
    "scale": ("scale", float),
    "offset": ("offset", float),
    "time": ("time", str),
    "event": ("event", str),
    "angle": ("angle", float),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", type=Path, help="the instrument's file; `lissajous info FILE` lists what it holds")
    parser.add_argument("--mapping", type=Path, help="TOML: which variable is which channel, unit, rate, device")
    parser.add_argument(
        "--channel", action="append", default=[], metavar="NAME=VARIABLE",
        help="for each channel, in place of a mapping; intensity=CH3,CH4 makes detectors of two variables; a "
        "variable whose name has a comma stands in double quotes",
    )  # fmt: skip
    for option, text in (("unit", "unit"), ("rate", "sample rate [Hz]"), ("start", "time of the first sample [s]")):
        parser.add_argument(
            f"--{option}", action="append", default=[], metavar=f"[NAME=]{option.upper()}",
            help=f"{text} of all channels, or of one, where the file does not state it",
        )  # fmt: skip
    for option, text in (("scale", "unit of the channel per count or unit of the file"), ("offset", "value at zero")):
        parser.add_argument(
            f"--{option}", action="append", default=[], metavar=f"[NAME=]{option.upper()}",
            help=f"{text}: channel = scale * variable + offset, of all channels, or of one",
        )  # fmt: skip
    parser.add_argument(
        "--time", action="append", default=[], metavar="[NAME=]COLUMN",
        help="variable that holds the times of all channels, or of one, in place of a rate",
    )  # fmt: skip
    for option, text in (
        ("event", "what an edge is: zero-crossing-up, zero-crossing-down, turn or both-edges"),
        ("angle", "angle of the detector [rad]"),
    ):
        parser.add_argument(
            f"--{option}", action="append", default=[], metavar=f"SYNC={option.upper()}",
            help=f"of a channel sync_x or sync_y, edge times or a sampled signal: {text}",
        )  # fmt: skip
    parser.add_argument("--format", help="format, if it follows neither from the file's beginning nor from its name")
    parser.add_argument("-o", "--output", type=Path, required=True, help="the recording to write (.h5)")


def run(args: argparse.Namespace) -> dict[str, Any]:
    from recon.io.convert import convert_file
    from scanner.errors import BadInput

    given = [f"--{name}" for name in ("channel", "format", *OPTIONS) if getattr(args, name)]
    if args.mapping is None:
        return convert_file(args.file, plan_of(args), args.output, by_options=True)
    if given:
        raise BadInput(
            f"is given together with {given[0]}", channel="--mapping", hint="state everything in one of them"
        )
    return convert_file(args.file, args.mapping, args.output)


def plan_of(args: argparse.Namespace) -> dict[str, Any]:
    """The mapping that the arguments state.

    Raises:
        BadInput: no channel, one without a variable, or a value that is none.
    """
    from recon.io.readers.text_table import split_fields
    from scanner.errors import BadInput

    hint = "as --channel sense_x=CH2 --unit V --rate 5e6, or write a --mapping"
    channels: dict[str, dict[str, Any]] = {}
    for text in args.channel:
        name, given, variable = (part.strip() for part in text.partition("="))
        if not (name and given and variable) or name in channels:
            raise BadInput(f"{text!r} is not NAME=VARIABLE, or repeats a channel", channel="--channel", hint=hint)
        variables = split_fields(variable, ",")
        channels[name] = {"variable": variables if len(variables) > 1 else variables[0]}
    if not channels:
        raise BadInput("no option assigns variables to channels", file=args.file, hint=f"assign them, {hint}")
    for option, (key, kind) in OPTIONS.items():
        for text in sorted(getattr(args, option), key=lambda each: "=" in each):  # what one channel has overrides
            name, given, value = text.rpartition("=")
            if given and name not in channels:
                raise BadInput(f"{name!r} is no channel named by --channel", channel=f"--{option}", hint=hint)
            try:
                said = kind(value)
            except ValueError:
                raise BadInput(f"{value!r} is no number", channel=f"--{option}", hint=hint) from None
            for each in [name] if given else channels:
                channels[each][key] = said
    return {"channels": channels} | ({"format": args.format} if args.format else {})


def format_summary(summary: dict[str, Any]) -> str:
    from scanner.channel_names import suggest_name

    lines = [f"{summary['recording']}: {summary['duration']:.6g} s, from {summary['source']} ({summary['format']})"]
    for name, own in summary["channels"].items():
        by = own["stated_by"]
        stated = own["stated_unit"] or own["unit"]
        line = f"  {name}: {own['variable']}, {stated} ({by['unit']})"
        line += "" if stated == own["unit"] else f" converted to {own['unit']}"
        line += f", {own['sample_rate']:.9g} Hz ({by['sample_rate']})"
        line += f", from {own['start']:.9g} s ({by['start']}), {counted(own['shape'][0], 'sample')}"
        line += "".join(f"; the file states {key} {value}" for key, value in own["overruled"].items())
        lines.append(line + suggest_name(name))
    lines += [
        f"  {name}: {counted(edges['number'], 'edge')}, {edges['event']}" for name, edges in summary["edges"].items()
    ]
    return "\n".join([*lines, *(f"  {note}" for note in summary["notes"])])
