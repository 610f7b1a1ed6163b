"""Recordings prepared for the fit: the band in which an axis without a noticeable spring is compared."""

from __future__ import annotations

import numpy as np
import pytest

from estimation.device_fit.data import prepare_run
from scanner.device import Axis, Device
from scanner.recording import Recording
from scanner.stages import Drive, Mechanics, Position

RATE, DURATION = 200.0, 40.0
SLIDE = Axis(
    Mechanics(95.0, 200.0, 1e-3), drive=Drive("linear", 35.0), readout=Position(1.0, 1e-6), name="x"
)  # a linear drive with friction and hardly a spring: its speed settles within J / b = 0.5 s


def test_the_band_of_an_overdamped_axis_contains_its_fastest_pole() -> None:
    rng = np.random.default_rng(3)
    drive = np.repeat(rng.standard_normal(int(DURATION)), int(RATE))
    position = 1e-3 * np.cumsum(drive) / RATE
    channels = {"drive_x": (drive, "V", RATE, 0.0), "sense_x": (position, "V", RATE, 0.0)}
    (output,) = prepare_run(Recording.from_arrays(channels), Device("slide", {"x": SLIDE})).outputs
    pole = 200.0 / 95.0 / (2 * np.pi)
    assert SLIDE.require_mechanics().fastest_pole == pytest.approx(pole, rel=1e-3)
    assert output.bins > 8 * pole * DURATION


@pytest.mark.parametrize("quality", [0.5, 0.7, 100.0])
def test_the_fastest_pole_of_an_axis_that_is_not_overdamped_is_its_resonance(quality: float) -> None:
    mechanics = Mechanics(1.0, 10.0 / quality, 100.0)
    assert mechanics.fastest_pole == pytest.approx(mechanics.resonance)
