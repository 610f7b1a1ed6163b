"""The figure of a phase: one time axis for phase and error, and no panel for an error that nothing shows."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from recon.report import figures
from recon.report.figures import phase_figure
from scanner.motion import AxisMotion

TIME_S = np.linspace(0.0, 0.04, 9)


@pytest.fixture
def drawings(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The figures that are drawn, in place of their texts."""
    drawn: list[Any] = []
    monkeypatch.setattr(figures, "figure_uri", drawn.append)
    return drawn


def motion() -> dict[str, AxisMotion]:
    ones = np.ones(TIME_S.size)
    return {"sensor": AxisMotion(TIME_S, 0.1 * TIME_S, ones, 1e3 * ones, 1e-3 * ones, None)}  # type: ignore[arg-type]


def test_phase_and_error_have_one_time_axis(drawings: list[Any]) -> None:
    phase_figure(motion(), 0.01, {}, [(0.02, 0.0, 1e-3)])
    top, bottom = drawings[0].axes
    assert bottom.get_xlim() == top.get_xlim()
    assert top.get_xlim()[0] <= 0.0
    assert top.get_xlim()[1] >= 40.0


def test_an_error_that_nothing_shows_has_no_panel(drawings: list[Any]) -> None:
    phase_figure(motion(), 0.01, {}, [(0.02, 0.0, np.inf), (0.03, 0.0, np.inf)])
    assert len(drawings[0].axes) == 1
