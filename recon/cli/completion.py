"""``lissajous completion SHELL``: a script by which the shell completes commands, options and files."""

from __future__ import annotations

import argparse
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from shlex import quote
from typing import Any

ALONE = {
    "reconstruct-from-recording": "reconstruct"
}  # separate commands, and the subcommand that each is equivalent to

Options = Sequence[argparse.Action]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("shell", choices=sorted(SCRIPTS), help="whose start-up file is to source the script")


def run(args: argparse.Namespace) -> dict[str, Any]:
    from recon.cli import COMMANDS, add_command

    options = {}
    for name in COMMANDS:
        parser = argparse.ArgumentParser()
        add_command(name, parser)
        options[name] = parser._actions
    return {"shell": args.shell, "script": SCRIPTS[args.shell](COMMANDS, options)}


def format_summary(summary: dict[str, Any]) -> str:
    return str(summary["script"])


def bash(commands: Mapping[str, str], options: Mapping[str, Options]) -> str:
    """Words for what begins with a dash and for what has choices; files for all else."""
    cases = []
    for name in commands:
        chosen = [(each.option_strings or ["*"], each.choices) for each in options[name] if each.choices]
        cases += [f'    "{name} "{flag}) words={quote(" ".join(c))} ;;' for flags, c in chosen for flag in flags]
        cases.append(f'    "{name} "*) [[ $current == -* ]] && words={quote(" ".join(_flags(options[name])))} ;;')
    alone = [f"    {name}) command={full} ;;" for name, full in ALONE.items()]
    return "\n".join(
        [
            "_lissajous() {",
            "  local words= command= current=${COMP_WORDS[COMP_CWORD]} before=${COMP_WORDS[COMP_CWORD-1]}",
            "  case ${COMP_WORDS[0]##*/} in",
            *alone,
            "    *) (( COMP_CWORD > 1 )) && command=${COMP_WORDS[1]} ;;",
            "  esac",
            '  case "$command $before" in',
            f'    " "*) words={quote(" ".join(commands))} ;;',
            *cases,
            "  esac",
            '  COMPREPLY=($(compgen -W "$words" -- "$current"))',
            "}",
            f"complete -o default -F _lissajous lissajous {' '.join(ALONE)}",
        ]
    )


def zsh(commands: Mapping[str, str], options: Mapping[str, Options]) -> str:
    """The same with a help text for each word."""
    described = [f"    {quote(f'{name}:{text}')}" for name, text in commands.items()]
    cases = []
    for name in commands:
        specs = [spec for each in options[name] for spec in _zsh_specs(each)]
        cases.append(f"    {name}) _arguments {' '.join(map(quote, specs))} ;;")
    return "\n".join(
        [
            "_lissajous() {",
            "  local command",
            "  local -a commands=(",
            *described,
            "  )",
            "  case $service in",
            *(f"    {name}) command={full} ;;" for name, full in ALONE.items()),
            "    *)",
            "      if (( CURRENT == 2 )); then _describe command commands; return; fi",
            "      command=$words[2]; shift words; (( CURRENT-- )) ;;",
            "  esac",
            "  case $command in",
            *cases,
            "  esac",
            "}",
            f"compdef _lissajous lissajous {' '.join(ALONE)}",
        ]
    )


def fish(commands: Mapping[str, str], options: Mapping[str, Options]) -> str:
    """The same, a line an option."""
    begin = "complete -c lissajous -f -n __fish_use_subcommand"
    lines = [f"{begin} -a {name} -d {quote(text)}" for name, text in commands.items()]
    begins = {f"complete -c lissajous -n '__fish_seen_subcommand_from {name}'": name for name in commands}
    begins |= {f"complete -c {name}": full for name, full in ALONE.items()}
    for begin, name in begins.items():
        for each in options[name]:
            flags = [f"-l {flag[2:]}" if flag.startswith("--") else f"-s {flag[1:]}" for flag in each.option_strings]
            words = f" -a {quote(' '.join(each.choices))}" if each.choices else ""
            value = "" if each.nargs == 0 else " -r" if _takes_file(each) else " -x"
            if flags:
                lines.append(f"{begin} {' '.join(flags)}{value}{words} -d {quote(_help(each))}")
            elif words:
                lines.append(f"{begin} -f{words}")
    return "\n".join(lines)


SCRIPTS = {"bash": bash, "zsh": zsh, "fish": fish}


def _flags(options: Options) -> list[str]:
    return [flag for each in options for flag in each.option_strings]


def _help(action: argparse.Action) -> str:
    return (action.help or "").replace("%%", "%")


def _takes_file(action: argparse.Action) -> bool:
    return action.type is Path or "FILE" in str(action.metavar)


def _zsh_specs(action: argparse.Action) -> list[str]:
    """What ``_arguments`` takes of one argument."""
    after = f"({' '.join(action.choices)})" if action.choices else "_files" if _takes_file(action) else " "
    if not action.option_strings:
        return [f"*:{action.dest}:{after}"]
    said = re.sub(r"([\[\]:\\])", r"\\\1", _help(action))
    value = "" if action.nargs == 0 else f":{action.dest}:{after}"
    return [f"*{flag}[{said}]{value}" for flag in action.option_strings]
