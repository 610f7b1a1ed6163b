"""Grammar of messages."""

from __future__ import annotations


def counted(number: int, noun: str) -> str:
    """Return a number with its noun, which is in the plural unless the number is 1: ``1 value``, ``3 values``."""
    return f"{number} {noun}" + ("" if number == 1 else "s")


def quantity(value: float, unit: str, digits: int = 4) -> str:
    """Return a value with ``digits`` significant digits and its unit, which may be empty: ``0.25 V``, ``0.25``."""
    return f"{value:.{digits}g} {unit}".rstrip()


def percent(share: float) -> str:
    """A share in percent; small ones with two significant digits, so that they never read as none."""
    return f"{100.0 * share:.0f}%" if share >= 0.1 else f"{100.0 * share:.2g}%"


def sentence(text: str) -> str:
    """Text with a capital first letter and a full stop; the name of a channel before a colon stays as it is."""
    first = text.split(maxsplit=1)[0]
    return f"{text if first.endswith(':') else text[0].upper() + text[1:]}."
