"""The catalogue of estimators: each file defines one estimator, what it needs and when to use it.

The algorithms do not belong here; a file imports them when its estimator runs.
"""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache
from pathlib import Path

from estimation.estimators.estimator import Estimator
from scanner.errors import BadInput
from scanner.user_files import load_objects

__all__ = ["Estimator", "estimators", "find_estimator", "register", "registered"]

_REGISTERED: dict[Path, dict[str, Estimator]] = {}


def estimators() -> dict[str, Estimator]:
    """Every estimator of this package and of registered files, by name in alphabetical order."""
    known = [*_own_estimators(), *(estimator for file in _REGISTERED.values() for estimator in file.values())]
    return {estimator.name: estimator for estimator in sorted(known, key=lambda estimator: estimator.name)}


def find_estimator(name: str) -> Estimator:
    """The estimator of that name.

    Raises:
        BadInput: there is none.
    """
    known = estimators()
    if name not in known:
        raise BadInput(f"no estimator is named {name!r}", channel="estimator", hint=f"there are {', '.join(known)}")
    return known[name]


def register(path: str | Path) -> None:
    """Add the estimators of a user's Python file to the catalogue.

    Raises:
        BadInput: no such file, it fails to run, or it defines no ``Estimator``.
    """
    file = Path(path).resolve()
    _REGISTERED[file] = {estimator.name: estimator for estimator in load_objects(Path(path), Estimator, "--estimators")}


def registered() -> tuple[Path, ...]:
    """The files whose estimators were added to the catalogue."""
    return tuple(_REGISTERED)


@cache
def _own_estimators() -> tuple[Estimator, ...]:
    names = [module.name for module in pkgutil.iter_modules(__path__) if module.name != "estimator"]
    return tuple(importlib.import_module(f"{__name__}.{name}").ESTIMATOR for name in names)
