"""Free decays of a linear device beside a constant drive, and behind a sensor with an offset."""

from __future__ import annotations

import numpy as np

from estimation.identification.agreement import IdentifiedValue
from estimation.identification.calibrate import identify
from scanner.device import Axis, Device
from scanner.recording import Recording
from scanner.stages import Drive, Mechanics

W, QUALITY, RATE = 2 * np.pi * 2000.0, 500.0, 2e5


def decay(offset: float = 0.0, volt: float = 0.0, seed: int = 5) -> dict[str, IdentifiedValue]:
    """Values from a decay behind a sensor with an offset [rad], beside a constant drive [V]."""
    mechanics, time = Mechanics(1e-12, 1e-12 * W / QUALITY, 1e-12 * W**2), np.arange(20_000) / RATE
    device = Device("mirror", {"x": Axis(mechanics, drive=Drive("linear", 1e-7), name="x")})
    turn = W * np.sqrt(1.0 - 0.25 / QUALITY**2) * time
    angle = 0.1 * np.exp(-0.5 * W / QUALITY * time) * np.cos(turn) + offset
    angle += 1e-5 * np.random.default_rng(seed).standard_normal(time.size)
    channels = {"angle_x": (angle, "rad", RATE), "drive_x": (np.full(time.size, volt), "V", RATE)}
    return dict(identify([Recording.from_arrays(channels)], device).values["x"])


def test_a_constant_voltage_on_a_linear_actuator_is_no_bias_of_combs() -> None:
    """It was refused for a capacitance that such a device does not have."""
    assert decay(volt=1e-3) == decay()


def test_the_offset_of_the_angle_widens_no_interval() -> None:
    """An offset of a fifth of the amplitude made the interval of k/J 2000 times as wide."""
    shifted, plain = decay(offset=0.02), decay()
    for key in ("k_over_J", "b_over_J"):
        assert abs(shifted[key].value - plain[key].value) < 0.1 * plain[key].sd
        assert shifted[key].sd < 1.01 * plain[key].sd
