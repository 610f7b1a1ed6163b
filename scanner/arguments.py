"""Checks of arguments of public functions, which type annotations do not enforce."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from numbers import Integral, Real

import numpy as np

from scanner.errors import BadInput


def check_flags(**flags: object) -> None:
    """Check that every argument is True or False. A text such as "no" would count as True.

    Args:
        flags: values by the name of their argument.

    Raises:
        BadInput: one is neither; the error names the argument.
    """
    for name, value in flags.items():
        if not isinstance(value, (bool, np.bool_)):
            raise BadInput(f"is {value!r}", channel=name, hint="give True or False")


def check_numbers(**numbers: object) -> None:
    """Check that every argument is a real number. A text such as "3" is none.

    Args:
        numbers: values by the name of their argument.

    Raises:
        BadInput: one is none; the error names the argument.
    """
    _check_types(Real, "give a number", numbers)


def check_whole_numbers(**numbers: object) -> None:
    """Check that every argument is a whole number; as :func:`check_numbers`. 3.0 is none."""
    _check_types(Integral, "give a whole number", numbers)


def check_pairs(kind: type, hint: str, **pairs: object) -> None:
    """Check that every argument is a sequence of two numbers of a kind.

    Args:
        kind: ``numbers.Real`` or ``numbers.Integral``.
        hint: what to give, with an example.
        pairs: by the name of their argument.

    Raises:
        BadInput: one is none; the error names the argument.
    """
    for name, pair in pairs.items():
        numbers = list(pair) if isinstance(pair, Iterable) else []
        if len(numbers) != 2 or not all(isinstance(n, kind) and not isinstance(n, bool) for n in numbers):
            raise BadInput(f"is {pair!r}", channel=name, hint=hint)


def check_type(kind: type, hint: str, **values: object) -> None:
    """Check that every argument is of a type.

    Args:
        kind: the type.
        hint: what to give in place of another one.
        values: by the name of their argument.

    Raises:
        BadInput: one is of another type; the error names the argument and the types.
    """
    for name, value in values.items():
        if not isinstance(value, kind):
            raise BadInput(f"is a {type(value).__name__}, no {kind.__name__}", channel=name, hint=hint)


def _check_types(kind: type, hint: str, values: Mapping[str, object]) -> None:
    for name, value in values.items():
        if not isinstance(value, kind) or isinstance(value, bool):
            raise BadInput(f"is {value!r}", channel=name, hint=hint)
