"""The command line, ``lissajous COMMAND``: one module a command, with its arguments, its work on files and its text.

Contains no estimation, no imaging and no drawing. A command's module has ``add_arguments(parser)``, ``run(args)``, that
returns the summary, and ``format_summary(summary)``, which returns the text for the terminal; it is imported only if
that command is called, and imports numpy and whatever takes long inside its functions.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import sys
from collections.abc import Mapping, Sequence
from io import TextIOWrapper
from pathlib import Path
from types import ModuleType
from typing import Any, NoReturn

from recon.runtime.interrupts import StopRequest, handle_interrupts

COMMANDS = {
    "reconstruct": "track the motion of a recording and map its intensities to a picture",
    "simulate": "make a recording with a known truth",
    "identify": "identify the constants of a device from recordings at rest, of a free decay and driven",
    "predict": "predict a recording from its drive with a device, and compare",
    "diagnose": "locate, name and model effects that the nominal device omits",
    "point-cloud": "turn angles and ranges of a LiDAR into points in space",
    "bidirectional": "measure and correct the line phase of a resonant raster film",
    "design": "find drive frequencies for a given field, resolution, frame rate and fill factor",
    "blur-study": "simulate and compare phantoms, scans, drifts, noise, estimators, resolutions and p in one table",
    "new-device": "write a commented device file for a kind of scanner",
    "info": "list the content of a recording or an instrument's file, with a mapping to start from",
    "convert": "turn an instrument's file into a recording",
    "completion": "print a script that completes commands, options and files in bash, zsh or fish",
}
"""Commands and their one-line help."""


COMPILED = ("reconstruct", "simulate", "identify", "predict", "diagnose", "design", "blur-study", "point-cloud")
"""Commands whose numerical code is compiled at the first run."""


INPUTS = ("recordings", "recording", "file", "film", "study")
"""Names of the arguments that are files which a command reads."""


class _PrintVersion(argparse.Action):
    """``--version``: print the installed version and exit."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        from importlib.metadata import version

        print(f"lissajous {version('lissajous')}")
        parser.exit()


class _Parser(argparse.ArgumentParser):
    """A parser that reports wrong arguments in one line."""

    def error(self, message: str) -> NoReturn:
        print(f"{self.prog}: {message}; see {self.prog} --help", file=sys.stderr)
        raise SystemExit(2)


def main(arguments: Sequence[str] | None = None, announce: bool = False) -> int:
    """Run one command; return the exit code: 0 done, 2 bad arguments or input, 1 anything else.

    Args:
        arguments: of the command; None takes those of the process.
        announce: say on stderr when code is compiled; also done where ``arguments`` is None.
    """
    # The matrices are small: threads inside BLAS slow them down, on a busy machine several times.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):  # a console without a character of the text shows a question mark
            stream.reconfigure(errors="replace")
    words = list(sys.argv[1:] if arguments is None else arguments)
    announce = announce or arguments is None
    with handle_interrupts() as stop:
        try:
            return _run_command(words, stop, announce)
        except BaseException as error:
            if not stop.came or isinstance(error, SystemExit):
                raise
            # Compiled code may turn an interrupt in a callback into another exception, a TypeError or a BadInput.
            print(f"lissajous {' '.join(words[:1])}: interrupted; nothing was written", file=sys.stderr)
            return 1


def _run_command(words: Sequence[str], stop: StopRequest, announce: bool) -> int:
    parser = _Parser(
        prog="lissajous", description="Resonant scanners: motion, pictures and missing physics from recordings."
    )
    parser.add_argument("--version", action=_PrintVersion, nargs=0, help="print the version and exit")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=_Parser)
    for name, text in COMMANDS.items():
        called = name in words[:1]  # only this command's module is imported, which keeps --help quick
        command = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + "." if called else None)
        if called:
            module = add_command(name, command)
            _check_not_empty(words[1:], command)
    args = parser.parse_args(words)
    return _run(module, args, f"{parser.prog} {args.command}", stop, announce and args.command in COMPILED)


def _check_not_empty(words: Sequence[str], parser: _Parser) -> None:
    """Exit with a line on an empty argument. As a path it would mean the current folder, as a name no name."""
    for before, word in zip(["", *words], words, strict=False):
        option, equals, value = word.partition("=") if word.startswith("-") else (before, "=", word)
        if equals and not value.strip():
            name = option if option.startswith("-") else "an argument"
            parser.error(f"{name} is given an empty text; write a value, or leave it out")


def add_command(name: str, parser: argparse.ArgumentParser) -> ModuleType:
    """Add a command's arguments to its parser; return its module."""
    module = importlib.import_module(f"recon.cli.{name.replace('-', '_')}")
    module.add_arguments(parser)
    parser.add_argument("--terms", type=Path, metavar="PATH", help="Python file with terms that a device uses")
    parser.add_argument("--estimators", type=Path, metavar="PATH", help="Python file with further estimators of motion")
    parser.add_argument("--readers", type=Path, metavar="PATH", help="Python file with readers of further file formats")
    parser.add_argument("--json", action="store_true", help="print the summary as JSON, and nothing else, on stdout")
    return module


def reconstruct_main() -> int:
    """``reconstruct-from-recording``: ``lissajous reconstruct`` as a separate command."""
    return main(["reconstruct", *sys.argv[1:]], announce=True)


def _run(module: ModuleType, args: argparse.Namespace, prog: str, stop: StopRequest, announce: bool) -> int:
    from scanner.errors import BadInput, line_of

    try:
        if args.terms is not None:
            from scanner.terms import register

            register(args.terms)
        if args.estimators is not None:
            from estimation.estimators import register as register_estimators

            register_estimators(args.estimators)
        if args.readers is not None:
            from recon.io.readers import register as register_readers

            register_readers(args.readers)
        if announce:
            from recon.runtime.compilation import announce_compilation

            announce_compilation()
        summary = module.run(args)
        stop.ended = True
        print(_format_json(summary) if args.json else _printable(module.format_summary(summary)))
        return int(summary.get("exit", 0))  # of several recordings, some may have failed
    except BadInput as error:
        if stop.came:  # an interrupt may have caused it
            raise
        if error.file is None and (error.channel or "").lstrip("-").replace("-", "_") not in vars(args):
            error.file = _inputs(args)
        print(f"{prog}: {error}", file=sys.stderr)
        return 2
    except MemoryError:
        print(f"{prog}: needs more memory than there is; cut the recording into shorter ones", file=sys.stderr)
        return 2
    except OSError as error:  # a full disk, a folder that may not be written
        print(f"{prog}: {line_of(error, 'output')}", file=sys.stderr)
        return 1


def _inputs(args: argparse.Namespace) -> str | None:
    """The files that a command reads, for an error that names neither a file nor an argument; None if there is none."""
    given = next((value for name in INPUTS if (value := getattr(args, name, None)) is not None), None)
    paths = given if isinstance(given, list) else [given]
    return None if given is None else ", ".join(map(str, paths[:3])) + (" and others" if len(paths) > 3 else "")


def _format_json(summary: Mapping[str, Any]) -> str:
    """A summary as JSON, with null for numbers that are not finite."""
    from recon.io.output import finite

    return json.dumps(finite(summary), indent=1)


def _printable(text: str) -> str:
    """Text without control characters, which names in a file may contain and a terminal would obey."""
    return "".join(c if c.isprintable() or c == "\n" else "\N{REPLACEMENT CHARACTER}" for c in text)


if __name__ == "__main__":
    sys.exit(main())
