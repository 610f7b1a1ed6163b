"""A linear drive whose size cannot give the motion that a sensor shows is named; one that can is not."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest

from recon.quality.drive_size import response_limits
from scanner.device import Device
from tests.support.two_axis_scan import (
    FIELD,
    FREQUENCIES_HZ,
    HALF_RAD,
    RATE_HZ,
    READOUTS,
    TIME,
    light,
    reconstruct,
    sensors,
)

J, Q, TORQUE_PER_VOLT = 1e-12, 50.0, 1e-7


def device(detuning: float = 1.0) -> Device:
    """Both axes with a resonance at a multiple of the frequency of the motion."""
    text = READOUTS + FIELD
    for axis, frequency in FREQUENCIES_HZ.items():
        omega = 2 * pi * frequency * detuning
        text += f"[{axis}.mechanics]\nJ = {J}\nb = {J * omega / Q}\nk = {J * omega**2}\n"
        text += f'[{axis}.drive]\nkind = "linear"\ntorque_per_volt = {TORQUE_PER_VOLT}\n'
    return Device.from_toml(text)


def notes(factor: float, detuning: float = 1.0) -> list[str]:
    """Notes on the drive of x, whose stated volts are ``factor`` times those that move the axis of the device."""
    made = device(detuning)
    omega = 2 * pi * FREQUENCIES_HZ["x"]
    mechanics = made.axis("x").mechanics
    response = TORQUE_PER_VOLT / abs(mechanics.k - mechanics.J * omega**2 + 1j * mechanics.b * omega)
    phase = 0.4 + 0.1 * TIME / TIME[-1] + (pi / 2 if detuning == 1.0 else 0.0)
    volts = factor * 0.97 * HALF_RAD / response * np.sin(omega * TIME + phase)
    channels = {**sensors(774201), "intensity": (light(774202), "V", RATE_HZ), "drive_x": (volts, "V", RATE_HZ)}
    result = reconstruct(channels, made.to_toml())
    return [note for note in result.notes if "and torque_per_volt" in note]


@pytest.mark.parametrize(("factor", "times"), [(1000.0, "least"), (1e-3, "most")])
def test_a_drive_in_another_unit_is_named(factor: float, times: str) -> None:
    [note] = notes(factor)
    assert note.startswith("drive_x: an amplitude of ")
    assert f"gives at {times} " in note
    assert "check the unit of drive_x and of the sensor" in note


@pytest.mark.parametrize(("factor", "detuning"), [(1.0, 1.0), (5.0, 1.0), (0.2, 1.0), (1.0, 1.25)])
def test_a_drive_that_can_give_the_motion_is_not_named(factor: float, detuning: float) -> None:
    assert not notes(factor, detuning)


def test_the_limits_contain_the_response_of_a_device_within_its_tolerances() -> None:
    omega, made = 2 * pi * FREQUENCIES_HZ["x"], device(1.01)
    least, most = response_limits(made, "x", FREQUENCIES_HZ["x"])
    mechanics = made.axis("x").mechanics
    for stiffer in (0.98, 1.0, 1.02):
        response = abs(mechanics.k * stiffer - mechanics.J * omega**2 + 1j * mechanics.b * omega)
        assert least < TORQUE_PER_VOLT / response < most
    assert response_limits(Device.from_toml(READOUTS + FIELD), "x", 1000.0) is None
