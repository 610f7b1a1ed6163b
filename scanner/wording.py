"""Grammar of messages."""

from __future__ import annotations


def counted(number: int, noun: str) -> str:
    """Return a number with its noun, which is in the plural unless the number is 1: ``1 value``, ``3 values``."""
    return f"{number} {noun}" + ("" if number == 1 else "s")
