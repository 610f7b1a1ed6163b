"""The part of the amplitude's uncertainty that comes from the calibration."""

from dataclasses import replace

import numpy as np
import pytest

from estimation.amplitude_calibration import amplitude_calibration_sd
from scanner import devices
from scanner.device import Device
from scanner.recording import Recording


def recording(*names: str) -> Recording:
    return Recording.from_arrays({name: (np.zeros(10), "rad" if "angle" in name else "V", 1e6) for name in names})


def test_a_small_amplitude_doubles_its_signal_with_the_square_of_the_angle() -> None:
    """S is proportional to A squared for a small A: 25 % of the gain are 12.5 % of the amplitude."""
    device = devices.load("imaging")
    device = replace(
        device,
        axes={name: replace(axis, tolerance={"C0": 0.0, "theta0": 0.0}) for name, axis in device.axes.items()},
        shared_tolerance={"a_cir": 0.25},
    )
    assert amplitude_calibration_sd(recording("sense"), device, "x", 1e-3, "tracker") == pytest.approx(0.125, rel=1e-3)
    wide = amplitude_calibration_sd(recording("sense"), device, "x", 0.18, "tracker")
    assert wide is not None
    assert wide > 0.15  # the signal saturates as the amplitude nears theta0


def test_position_readouts_angles_and_pictures() -> None:
    device = Device.from_toml(
        '[x.readout]\nkind = "position"\ngain = 2.0\nnoise_sd = 0.1\n[x.tolerance]\ngain = 0.25\n'
    )
    assert amplitude_calibration_sd(recording("sense_x"), device, "x", 0.1, "sensor") == 0.25
    assert amplitude_calibration_sd(recording("angle_x"), device, "x", 0.1, "sensor") == 0.0
    assert amplitude_calibration_sd(recording("intensity"), device, "x", 0.1, "picture") is None
