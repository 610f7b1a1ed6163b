"""The steady motion of an axis without a sense signal, under a linear drive: against the law of a driven oscillator."""

from __future__ import annotations

import numpy as np
import pytest

from estimation.tracker.drive_only import drive_only_observations, find_steady_motion
from scanner.device import Device
from scanner.recording import Recording

RATE_HZ, VOLTS, TORQUE_PER_VOLT, J, Q = 1e6, 5.0, 1e-6, 1e-10, 100.0


@pytest.mark.parametrize("drive_hz", [1800.0, 1865.0, 1870.0, 1880.0])
def test_a_linear_drive_sustains_the_motion_of_the_driven_oscillator(drive_hz: float) -> None:
    w0, w = 2 * np.pi * 1870.0, 2 * np.pi * drive_hz
    b, k = J * w0 / Q, J * w0**2
    device = Device.from_toml(
        f'[x.mechanics]\nJ = {J}\nb = {b}\nk = {k}\n[x.drive]\nkind = "linear"\ntorque_per_volt = {TORQUE_PER_VOLT}\n'
    )
    drive = VOLTS * np.sin(w * np.arange(40_000) / RATE_HZ)
    light = np.random.default_rng(771001).poisson(20.0, drive.size).astype(float)
    recording = Recording.from_arrays({"drive_x": (drive, "V", RATE_HZ), "intensity": (light, "V", RATE_HZ)}, device)
    motion = find_steady_motion(drive_only_observations(recording, device, "x"))
    assert motion is not None
    response = VOLTS * TORQUE_PER_VOLT / (k - J * w**2 + 1j * b * w)
    assert np.exp(motion.log_amplitude) == pytest.approx(abs(response), rel=1e-4)
    assert np.angle(np.exp(1j * (motion.phase - np.angle(response)))) == pytest.approx(0.0, abs=1e-3)
