"""Checks of arguments of public functions, which type annotations do not enforce."""

from __future__ import annotations

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
