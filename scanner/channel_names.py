"""Misspelt names of channels, for messages."""

from __future__ import annotations

from collections.abc import Iterable

from scanner.channel import USED_CHANNELS

MIN_NAME_SIMILARITY = 0.8
"""Similarity (``difflib``) from which an unknown channel name counts as misspelt: one or two letters of six."""


def suggest_name(name: str) -> str:
    """The known channel name nearest to an unknown one, as the end of a message; empty if none is near."""
    from difflib import get_close_matches

    known = (*USED_CHANNELS, "sync_x", "sync_y")
    near = [] if name in known else get_close_matches(name.lower(), known, 1, MIN_NAME_SIMILARITY)
    return f"; is it {near[0]}?" if near else ""


def list_names(names: Iterable[str]) -> str:
    """The names of a recording's channels and what misspelt ones may be, as the end of a message."""
    listed = sorted(names)
    return ", ".join(listed) + "".join(f"; {name}{suggest_name(name)}" for name in listed if suggest_name(name))
