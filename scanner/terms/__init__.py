"""The catalogue of effects that a nominal device leaves out: one file, one effect.

Nothing in here simulates, estimates or reads recordings: ``scanner.forward_model`` and the estimators apply the laws.
"""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache
from pathlib import Path

from scanner.errors import BadInput
from scanner.interpolation import shift_samples
from scanner.lowpass import apply_lowpass
from scanner.terms.term import STAGES, NaturalScales, Parameter, SignalContext, Term
from scanner.user_files import load_objects

__all__ = [
    "STAGES",
    "NaturalScales",
    "Parameter",
    "SignalContext",
    "Term",
    "apply_lowpass",
    "catalogue",
    "load_terms",
    "register",
    "registered",
    "shift_samples",
]


_REGISTERED: dict[Path, dict[str, Term]] = {}


def catalogue() -> dict[str, Term]:
    """Return every term of this package and of registered files by its effect, in the order of the stages."""
    terms = [*_builtin_terms(), *(term for terms in _REGISTERED.values() for term in terms.values())]
    return {term.effect: term for term in sorted(terms, key=lambda term: (STAGES.index(term.stage), term.effect))}


def register(path: str | Path) -> None:
    """Add the terms of a user's file to the catalogue. Raises as :func:`load_terms`."""
    _REGISTERED[Path(path).resolve()] = load_terms(path)


def registered() -> tuple[Path, ...]:
    """Return the registered term files."""
    return tuple(_REGISTERED)


NOT_IN_CATALOGUE = ("term", "measured_law", "driven_modes")
"""Modules here that hold no effect of the search: the base class, and what only a device file states."""


@cache
def _builtin_terms() -> tuple[Term, ...]:
    names = [module.name for module in pkgutil.iter_modules(__path__) if module.name not in NOT_IN_CATALOGUE]
    return tuple(importlib.import_module(f"{__name__}.{name}").TERM for name in names)


def load_terms(path: str | Path) -> dict[str, Term]:
    """Return the terms in a user's file, which is every :class:`Term` in it, by the name of its effect.

    Raises:
        BadInput: no such file, it fails to run, or it holds no term.
    """
    path = Path(path)
    terms = load_objects(path, Term, "--terms")
    for term in terms:
        if term.stage not in STAGES:
            hint = f"stages: {', '.join(STAGES)}"
            raise BadInput(f"stage {term.stage!r} is unknown", file=path, channel=term.effect, hint=hint)
    return {term.effect: term for term in terms}
