"""Tables of the reference that are made from the program itself, so that no key and no option can be missing.

A page holds ``<!-- generated: NAME -->`` where the table of that name belongs; ``conf.py`` puts it there.
"""

from __future__ import annotations

import argparse
import html
import inspect
import re
from collections.abc import Callable
from dataclasses import MISSING, fields

from estimation.estimators import estimators
from recon.cli import COMMANDS, add_command
from scanner.geometry import Geometry
from scanner.stages import READOUTS, Capacitance, Drive, Mechanics, Scan
from scanner.terms import STAGES, Term, catalogue

DEVICE_TABLES: dict[str, type] = {
    "[x.mechanics], [y.mechanics]": Mechanics,
    "[x.capacitance], [y.capacitance]": Capacitance,
    "[x.drive], [y.drive]": Drive,
    **{f'[x.readout], [y.readout] or [readout], kind = "{kind}"': readout for kind, readout in READOUTS.items()},
    "[scan]": Scan,
    "[geometry]": Geometry,
}
"""Heading of a table of the device file -> the dataclass whose fields are its keys."""


def attribute_texts(record: type) -> dict[str, str]:
    """Text of every attribute in the ``Attributes:`` sections of a class and its bases, by the attribute's name."""
    texts: dict[str, str] = {}
    for described in reversed(record.__mro__):
        section = inspect.cleandoc(described.__doc__ or "").partition("Attributes:\n")[2]
        section = re.sub(r"\n\s{6,}", " ", section)  # continuation lines
        for names, text in re.findall(r"^ {4}([\w, ]+): (.*)$", section, re.MULTILINE):
            texts |= dict.fromkeys(re.split(r",\s*", names), text)
    return texts


def device_tables() -> str:
    """Every key of the device file with unit, default and meaning."""
    parts = []
    for heading, record in DEVICE_TABLES.items():
        texts = attribute_texts(record)
        rows = []
        for item in fields(record):
            text = texts[item.name]
            unit = re.search(r"\[([^\]]+)\]", text)
            default = "required" if item.default is MISSING else "none" if item.default is None else f"{item.default}"
            meaning = re.sub(r"\s*\[[^\]]+\]", "", text).replace("``", "`").replace("|", "\\|")
            kind = item.metadata.get("must", "text").removeprefix("be ")
            kind = f"list, each {kind}" if "tuple" in str(item.type) else kind
            rows.append([f"`{item.name}`", unit[1] if unit else "", default, kind, meaning])
        if record in READOUTS.values():
            rows.insert(0, ["`kind`", "", "required", "text", f'"{record.kind}"'])  # type: ignore[attr-defined]
        parts.append(f"### `{heading}`\n\n{(inspect.getdoc(record) or '').splitlines()[0].replace('``', '`')}\n")
        parts.append(_table(["key", "unit", "default", "value", "meaning"], rows))
    return "\n".join(parts)


def command_parser(name: str) -> argparse.ArgumentParser:
    """The parser of one command with all its options."""
    parser = argparse.ArgumentParser(prog=f"lissajous {name}", add_help=False)
    add_command(name, parser)
    return parser


def command_sections() -> str:
    """Every command with all its arguments and options."""
    parts = []
    for name, text in COMMANDS.items():
        rows = []
        for action in command_parser(name)._actions:
            label = ", ".join(f"`{option}`" for option in action.option_strings) or f"`{action.metavar or action.dest}`"
            value = str(action.metavar or (action.dest.upper() if action.nargs != 0 else "")).replace("|", "\\|")
            if action.option_strings and value:
                label += f" `{value}`"
            required = "yes" if action.required else "no"
            choices = f": {', '.join(map(str, action.choices))}" if action.choices else ""
            rows.append([label, required, (action.help or "").replace("|", "\\|") + choices])
        parts.append(f"## `lissajous {name}`\n\n{text[0].upper()}{text[1:]}.\n")
        parts.append(_table(["argument", "required", "meaning"], rows))
    return "\n".join(parts)


def effect_sections() -> str:
    """Every effect of the catalogue, stage by stage."""
    parts = []
    for stage in STAGES:
        entries = [_effect(term) for term in catalogue().values() if term.stage == stage]
        parts += [f"## {stage.capitalize()}", *entries]
    return "\n\n".join(parts)


def set_equation(equation: str) -> str:
    """An equation's text as HTML: ``_i`` and the number of a letter lowered, ``^(..)`` and ``^2`` raised."""
    text = html.escape(equation, quote=False)
    text = re.sub(r"_([A-Za-z0-9]+)|(?<=[A-Za-zα-ω])(\d)(?![A-Za-z0-9])", r"<sub>\1\2</sub>", text)
    return re.sub(r"\^(?:\(([^)]*)\)|(\d))", r"<sup>\1\2</sup>", text)


def _effect(term: Term) -> str:
    units = ", ".join(f"`{p.name}`" + ("" if p.unit == "1" else f" [{set_equation(p.unit)}]") for p in term.parameters)
    lines = [
        f"### {term.effect}",
        f'<p class="equation"><i>{set_equation(term.equation)}</i></p>',
        f"Parameters: {units}{_variants(term)}. Source: {term.source}.",
        *(f"- Confounder [{other}](#{other}): {apart}." for other, apart in term.confounders.items()),
    ]
    return "\n\n".join(lines[:3]) + "\n\n" + "\n".join(lines[3:])


def _variants(term: Term) -> str:
    """Which channel ``variant`` selects, for a term that may act on several."""
    if len(term.variants) < 2:
        return ""
    channels = ", ".join(f"{i} `{channel}`" for i, channel in enumerate(term.variants))
    return f"; `variant` selects the channel, 0 unless stated: {channels}"


def _table(head: list[str], rows: list[list[str]]) -> str:
    lines = [f"| {' | '.join(cells)} |" for cells in (head, ["---"] * len(head), *rows)]
    return "\n".join(lines) + "\n"


DEMO_PHASE_ERRORS = {
    "acm": "3.81°, 4.15°",
    "constant": "3.78°, 4.37°",
    "ekf": "0.103°, 0.030°",
    "picture": "0.021°, 0.004°",
    "tracker": "0.007°, 0.006°",
    "tracker-causal": "0.016°, 0.011°",
    "ukf": "0.103°, 0.030°",
}
"""Phase error of x and y, rms, in the demo's recording; how it is measured is on the page of the estimators."""


def estimator_table() -> str:
    """Every estimator as it describes itself, and its phase error in the demo."""
    rows = [
        [f"`{each.name}`", each.summary, each.needs, each.use_when, each.source, DEMO_PHASE_ERRORS.get(each.name, "")]
        for each in estimators().values()
    ]
    return _table(["name", "what it does", "what it needs", "when to use it", "source", "in the demo"], rows)


TABLES: dict[str, Callable[[], str]] = {
    "device": device_tables,
    "commands": command_sections,
    "effects": effect_sections,
    "estimators": estimator_table,
}


def with_tables(page: str) -> str:
    """The page with every ``<!-- generated: NAME -->`` replaced by the table of that name."""
    return re.sub(r"<!-- generated: (\w+) -->", lambda found: TABLES[found[1]](), page)
