"""Recordings prepared for the fit: the band of an axis without a noticeable spring, and natural scales."""

from __future__ import annotations

from dataclasses import replace

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


def test_the_scales_of_an_axis_without_a_recorded_readout_are_those_of_its_angle() -> None:
    """A fast axis with a sense signal beside a slow one, far below its resonance, with an angle."""
    rate, resonance = 50e3, 1e3
    axis = Axis(
        Mechanics(1e-9, 1e-6, 1e-9 * (2 * np.pi * resonance) ** 2),
        drive=Drive("linear", 1e-4),
        readout=Position(10.0, 1e-3),
    )
    time, noise = np.arange(20_000) / rate, np.random.default_rng(0).standard_normal(20_000)
    fast, slow = np.sin(2 * np.pi * resonance * time), np.cos(2 * np.pi * 20.0 * time)
    signals = {"drive_x": fast, "drive_y": slow, "sense_x": 0.1 * fast + 1e-3 * noise, "angle_y": 2.5e-3 * slow}
    channels = {key: (each, "rad" if key == "angle_y" else "V", rate, 0.0) for key, each in signals.items()}
    device = Device("stage", {"x": replace(axis, name="x"), "y": replace(axis, name="y")})
    scales = prepare_run(Recording.from_arrays(channels), device).scales["y"]
    assert scales.rate == pytest.approx(2 * np.pi * 20.0, rel=1e-3)
    assert scales.sense_rms == pytest.approx(2.5e-3 / np.sqrt(2.0), rel=0.01)
