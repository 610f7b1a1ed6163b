"""Python files of users that extend the program: terms, file readers."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import TypeVar

from scanner.errors import BadInput

T = TypeVar("T")


def load_objects(path: Path, kind: type[T], option: str) -> list[T]:
    """Run a user's Python file and return every object of a type that it defines.

    Args:
        path: the file.
        kind: type of the objects.
        option: of the command line that takes such a file, for messages.

    Raises:
        BadInput: no such file, it fails to run, or it defines no such object.
    """
    name = kind.__name__.lower()
    hint = f"{option} takes a Python file that defines a {kind.__name__}"
    if not path.is_file():
        raise BadInput("no such file", file=path, hint=hint)
    spec = importlib.util.spec_from_file_location(f"{name}s_of_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise BadInput("is not a Python file", file=path, hint=hint)
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:  # a user's code may raise anything; the user gets it in one line
        what = f"fails to run: {type(error).__name__}: {error}"
        raise BadInput(what, file=path, hint=f"correct the {name} file") from error
    objects = [value for value in vars(module).values() if isinstance(value, kind)]
    if not objects:
        raise BadInput(f"holds no {name}", file=path, hint=f"define a {kind.__module__}.{kind.__name__} in it")
    return objects
