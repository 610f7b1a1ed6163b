"""Entries of ``results.json``, and figures drawn like those of the papers."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
FIGURES = HERE / "figures"

Results = dict[str, dict[str, Any]]


def entry(paper: float | None, ours: float, n: int, seed: int, **more: Any) -> dict[str, Any]:
    """One entry: the paper's number, ours, the number of trials, and the first seed."""
    return {
        "paper": paper,
        "ours": round(float(ours), 7) if abs(ours) < 100 else float(ours),
        "n": n,
        "seed": seed,
        **more,
    }


@contextmanager
def figure(name: str, rows: int = 1, columns: int = 1, size: tuple[float, float] = (7.0, 3.2)) -> Iterator[Any]:
    """Axes to draw on, saved as ``figures/<name>.png``."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    drawing, axes = plt.subplots(rows, columns, figsize=size, squeeze=False)
    yield axes
    drawing.tight_layout()
    FIGURES.mkdir(exist_ok=True)
    drawing.savefig(FIGURES / f"{name}.png", dpi=110, metadata={"Software": None})
    plt.close(drawing)
