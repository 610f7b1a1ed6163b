"""The report of ``identify``: labels, rounded intervals, and a figure of a frequency response."""

from pathlib import Path

import numpy as np
import pytest

from recon.cli.identify import UNITS, identify_files
from recon.report.identification import LABELS
from recon.report.numbers import format_range
from scanner.device import Axis, Device
from scanner.recording import Recording
from scanner.stages import Mechanics, Position

RATE = 2 * np.pi * 800.0


def steady_tones() -> Recording:
    """Frequency response of a resonance at 800 Hz with a Q of 300."""
    frequency = np.linspace(795.0, 805.0, 25)
    ratio, rng = frequency / 800.0, np.random.default_rng(20)
    response = 0.1 / 300.0 / (1.0 - ratio**2 + 1j * ratio / 300.0)
    response += 5e-5 * (rng.normal(size=ratio.size) + 1j * rng.normal(size=ratio.size))
    extra = {"reference": "frequency"}
    axis = Axis(Mechanics(2.0, 2.0 * RATE / 300.0, 2.0 * RATE**2), readout=Position(10.0, 1e-4), name="x")
    channels = {
        "frequency": (frequency, "Hz", 1.0),
        "amplitude_x": (np.abs(response), "rad", 1.0, 0.0, extra),
        "phase_x": (np.angle(response), "rad", 1.0, 0.0, extra),
    }
    return Recording.from_arrays(channels, Device("lever", {"x": axis}))


def test_steady_tones_are_shown_with_their_fit_and_readable_names(tmp_path: Path) -> None:
    steady_tones().write(tmp_path / "tones.h5")
    summary = identify_files([tmp_path / "tones.h5"], tmp_path / "out")
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert page.count("data:image/svg+xml") == 1
    assert "frequency response of x: resonance (" in page
    assert "k_over_J" not in page
    assert "stiffness k" in page
    assert format_range(*summary["axes"]["x"]["values"]["b"]["ci95"]) in page


def test_every_constant_has_a_readable_name() -> None:
    assert LABELS.keys() == UNITS.keys()


@pytest.mark.parametrize(
    ("low", "high", "text"),
    [
        (38.6755, 41.8328, "38.7 to 41.8"),
        (4.86730e7, 5.26446e7, "4.87 · 10⁷ to 5.26 · 10⁷"),
        (-0.0123, 0.0456, "−0.012 to 0.046"),
        (2.0, 2.0, "2.000 to 2.000"),
    ],
)
def test_an_interval_is_rounded_to_its_width(low: float, high: float, text: str) -> None:
    assert format_range(low, high) == text
