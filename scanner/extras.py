"""Libraries that only some users need, imported where they are used."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from scanner.errors import BadInput


def import_extra(module: str, extra: str) -> Any:
    """Return a module of an optional library.

    Args:
        module: to import.
        extra: of this package that installs it.

    Raises:
        BadInput: it is not installed.
    """
    try:
        return import_module(module)
    except ModuleNotFoundError:
        raise BadInput(f"{module} is not installed", hint=f"pip install 'lissajous[{extra}]'") from None
