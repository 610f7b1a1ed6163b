"""The command line: ``lissajous COMMAND``. Each command is a module of ``recon.commands``, imported when asked for."""

from __future__ import annotations

import argparse
import importlib
import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import NoReturn

from recon.stopping import stoppable

COMMANDS = {
    "reconstruct": "track the motion of a recording and map its intensities to a picture",
    "simulate": "make a recording with a known truth",
    "identify": "find a device's constants from recordings at rest, ringing down and driven",
    "predict": "play a recording's drive through a device and compare",
    "diagnose": "locate, name and model what the nominal device leaves out",
    "design": "find drive frequencies for a wanted field, resolution, frame rate and fill",
    "blur-study": "phantoms, scans, drifts, noise, estimators, resolutions and p against each other, as one table",
    "info": "list what a recording or an instrument's file holds, with a mapping to start from",
    "convert": "turn an instrument's file into a recording",
    "completion": "print a script by which bash, zsh or fish completes all this",
}


class _Parser(argparse.ArgumentParser):
    """Says what is wrong with the arguments in one line."""

    def error(self, message: str) -> NoReturn:
        print(f"{self.prog}: {message}; see {self.prog} --help", file=sys.stderr)
        raise SystemExit(2)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code: 0 done, 2 bad arguments or input, 1 anything else."""
    # The matrices here are small: threads inside BLAS cost more than they bring, several times over on a busy machine.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    given = list(sys.argv[1:] if arguments is None else arguments)
    with stoppable() as stop:
        try:
            return _command(given)
        except BaseException as error:
            if not stop.came or isinstance(error, SystemExit):
                raise
            # Compiled code makes of an interrupt in a callback whatever it likes, a TypeError for one.
            print(f"lissajous {' '.join(given[:1])}: interrupted; nothing was written", file=sys.stderr)
            return 1


def _command(given: Sequence[str]) -> int:
    parser = _Parser(
        prog="lissajous", description="Resonant scanners: motion, pictures and missing physics from recordings."
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=_Parser)
    for name, text in COMMANDS.items():
        asked_for = name in given[:1]  # only its module is imported, so that --help stays quick
        command = commands.add_parser(
            name, help=text, description=text[0].upper() + text[1:] + "." if asked_for else None
        )
        if asked_for:
            module = add_command(name, command)
    args = parser.parse_args(given)
    return _run(module, args, f"{parser.prog} {args.command}")


def add_command(name: str, parser: argparse.ArgumentParser) -> ModuleType:
    """Add a command's arguments to its parser; returns its module."""
    module = importlib.import_module(f"recon.commands.{name.replace('-', '_')}")
    module.add_arguments(parser)
    parser.add_argument("--terms", type=Path, metavar="PATH", help="Python file with terms that a device uses")
    parser.add_argument("--json", action="store_true", help="print the summary as JSON, and nothing else, on stdout")
    return module


def reconstruct_main() -> int:
    """``reconstruct-from-recording``: ``lissajous reconstruct`` under the name people look for."""
    return main(["reconstruct", *sys.argv[1:]])


def _run(module: ModuleType, args: argparse.Namespace, prog: str) -> int:
    from scanner.errors import BadInput, line_of

    try:
        if args.terms is not None:
            from scanner.terms import register

            register(args.terms)
        summary = module.run(args)
        print(json.dumps(summary, indent=1) if args.json else _printable(module.tell(summary)))
        return int(summary.get("exit", 0))  # of many, some may have failed
    except BadInput as error:
        print(f"{prog}: {error}", file=sys.stderr)
        return 2
    except MemoryError:
        print(f"{prog}: needs more memory than there is; cut the recording into shorter ones", file=sys.stderr)
        return 2
    except OSError as error:  # a full disk, a folder that may not be written
        print(f"{prog}: {line_of(error, 'output')}", file=sys.stderr)
        return 1


def _printable(text: str) -> str:
    """Text without what a file's own names could do to a terminal."""
    return "".join(c if c.isprintable() or c == "\n" else "\N{REPLACEMENT CHARACTER}" for c in text)


if __name__ == "__main__":
    sys.exit(main())
