"""Source code of the compiled filters: scalar code for one model, with every matrix product unrolled.

Small arrays inside a compiled loop cost ten times as much as scalars in registers. The source is therefore generated
for a given model (axes, readout, sections), kept in the user's cache folder and compiled by numba, which caches the
machine code beside it. The readable statement of the same filters is ``estimation.filters.filterpy_engine``.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from types import ModuleType

Matrix = dict[tuple[int, int], str]


def sum_source(terms: Iterable[str]) -> str:
    """A sum as source text; empty terms are left out."""
    return " + ".join(filter(None, terms)) or "0.0"


def product_source(a: str, b: str) -> str:
    """A product as source text, without multiplying by one."""
    return b if a == "1.0" else a if b == "1.0" else f"{a} * {b}"


def symmetric_entry(name: str, i: int, j: int) -> str:
    """Name of an element of a symmetric matrix whose upper triangle is stored."""
    return f"{name}{min(i, j)}_{max(i, j)}"


def covariance_prediction(F: Matrix, n: int, noise: Matrix) -> list[str]:
    """P <- F P F' + Q for a sparse F, as lines of source."""
    rows = {i: [j for j in range(n) if (i, j) in F] for i in range(n)}
    lines = [
        f"g{i}_{j} = {sum_source(product_source(F[i, l], symmetric_entry('p', l, j)) for l in rows[i])}"
        for i in range(n)
        for j in range(n)
    ]
    for i in range(n):
        for j in range(i, n):
            terms = [product_source(F[j, l], f"g{i}_{l}") for l in rows[j]] + ([noise[i, j]] if (i, j) in noise else [])
            lines.append(f"p{i}_{j} = {sum_source(terms)}")
    return lines


def cholesky_source(n: int, scale: str) -> list[str]:
    """L with L L' = scale P, as lines of source; a pivot that is not positive gives NaN, which the caller checks."""
    lines = []
    for j in range(n):
        for i in range(j, n):
            rest = "".join(f" - l{i}_{k} * l{j}_{k}" for k in range(j))
            entry = f"{scale} * {symmetric_entry('p', i, j)}{rest}"
            lines.append(f"l{j}_{j} = math.sqrt({entry})" if i == j else f"l{i}_{j} = ({entry}) * r{j}")
            if i == j:
                lines.append(f"r{j} = 1.0 / l{j}_{j}")
    return lines


def compile_source(source: str, entry: str, *dependencies: ModuleType) -> Callable[..., None]:
    """The function ``entry`` of ``source``, compiled by numba at its first call and cached for the next process.

    Args:
        dependencies: modules whose functions the source calls. Their text is part of the cached file's name, because
            numba does not notice when they change.
    """
    text = source + "".join(Path(module.__file__ or "").read_text(encoding="utf-8") for module in dependencies)
    name = f"lissajous_{entry}_{hashlib.sha256(text.encode()).hexdigest()[:16]}"
    if name not in sys.modules:
        folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "lissajous"
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{name}.py"
        if not path.exists():
            temporary = folder / f"{name}.{os.getpid()}.tmp"
            temporary.write_text(source, encoding="utf-8")
            temporary.replace(path)
        spec = importlib.util.spec_from_file_location(name, path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module
        spec.loader.exec_module(module)
    return getattr(sys.modules[name], entry)
