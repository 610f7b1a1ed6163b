"""The catalogue of physics that a nominal device may leave out: one file, one effect."""

from __future__ import annotations

import importlib
import importlib.util
import pkgutil
from functools import cache
from pathlib import Path

from scanner.errors import BadInput
from scanner.terms.term import STAGES, Parameter, Scales, Term, View, section, shifted

__all__ = [
    "STAGES",
    "Parameter",
    "Scales",
    "Term",
    "View",
    "catalogue",
    "load_terms",
    "register",
    "registered",
    "section",
    "shifted",
]


_REGISTERED: dict[Path, dict[str, Term]] = {}


def catalogue() -> dict[str, Term]:
    """Every term of this package and of registered files by the effect's name, in the order of the stages."""
    terms = [*_own_terms(), *(term for each in _REGISTERED.values() for term in each.values())]
    return {term.effect: term for term in sorted(terms, key=lambda term: (STAGES.index(term.stage), term.effect))}


def register(path: str | Path) -> None:
    """Take the terms of a user's own file into the catalogue; raises as :func:`load_terms`."""
    _REGISTERED[Path(path).resolve()] = load_terms(path)


def registered() -> tuple[Path, ...]:
    """The term files taken into the catalogue."""
    return tuple(_REGISTERED)


@cache
def _own_terms() -> tuple[Term, ...]:
    names = [module.name for module in pkgutil.iter_modules(__path__) if module.name != "term"]
    return tuple(importlib.import_module(f"{__name__}.{name}").TERM for name in names)


def load_terms(path: str | Path) -> dict[str, Term]:
    """The terms of a user's own file: everything in it that is a :class:`Term`, by the effect's name.

    Raises:
        BadInput: no such file, it fails to run, or it holds no term.
    """
    path = Path(path)
    if not path.is_file():
        raise BadInput("no such file", file=path, hint="--terms takes a Python file that holds a Term")
    spec = importlib.util.spec_from_file_location(f"terms_of_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise BadInput("is not a Python file", file=path, hint="--terms takes a .py file that holds a Term")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:  # whatever the user's code raises is the user's to read, in one line
        what = f"fails to run: {type(error).__name__}: {error}"
        raise BadInput(what, file=path, hint="correct the term file") from error
    terms = [value for value in vars(module).values() if isinstance(value, Term)]
    if not terms:
        raise BadInput("holds no term", file=path, hint="make a scanner.terms.Term in it")
    for term in terms:
        if term.stage not in STAGES:
            hint = f"stages: {', '.join(STAGES)}"
            raise BadInput(f"stage {term.stage!r} is unknown", file=path, channel=term.effect, hint=hint)
    return {term.effect: term for term in terms}
