"""The steady motion of an axis without a sense signal, under a linear drive: against the law of a driven oscillator."""

from __future__ import annotations

import numpy as np
import pytest

from estimation.tracker.drive_only import drive_only_observations, track_drive_only
from estimation.tracker.steady_motion import find_steady_branch, find_steady_motion
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


def oscillator(resonance_hz: float, tolerance: float) -> tuple[Device, complex]:
    """A device driven at 1870 Hz, and its response [rad / (N m)]."""
    w0, w = 2 * np.pi * resonance_hz, 2 * np.pi * 1870.0
    b, k = J * 2 * np.pi * 1870.0 / Q, J * w0**2
    device = Device.from_toml(
        f"[x.mechanics]\nJ = {J}\nb = {b}\nk = {k}\n[x.tolerance]\nk = {tolerance}\n"
        f'[x.drive]\nkind = "linear"\ntorque_per_volt = {TORQUE_PER_VOLT}\n'
    )
    return device, 1.0 / (k - J * w**2 + 1j * b * w)


def driven(device: Device) -> Recording:
    drive = VOLTS * np.sin(2 * np.pi * 1870.0 * np.arange(40_000) / RATE_HZ)
    light = np.random.default_rng(61_401).poisson(20.0, drive.size).astype(float)
    return Recording.from_arrays({"drive_x": (drive, "V", RATE_HZ), "intensity": (light, "V", RATE_HZ)}, device)


def test_the_steady_motions_over_the_stiffness_are_those_of_the_driven_oscillator() -> None:
    device, _ = oscillator(1865.0, 0.02)
    mechanics = device.axis("x").require_mechanics()
    branch = find_steady_branch(drive_only_observations(driven(device), device, "x"), 0.02)
    assert branch is not None
    assert branch.stiffness[[0, -1]] == pytest.approx([-0.06, 0.06])
    w = 2 * np.pi * 1870.0
    k = mechanics.k * (1.0 + branch.stiffness)
    response = VOLTS * TORQUE_PER_VOLT / (k - J * w**2 + 1j * mechanics.b * w)
    assert np.exp(branch.log_amplitude) == pytest.approx(np.abs(response), rel=1e-3)
    assert branch.phase == pytest.approx(np.angle(response), abs=2e-3)


@pytest.mark.parametrize("tolerance", [0.006, 0.02])
def test_the_phase_by_the_drive_alone_has_an_honest_standard_deviation(tolerance: float) -> None:
    """Errors and standard deviations have the same rms over devices with stiffnesses off by draws of the tolerance.

    A single phase is not normally distributed: with a tolerance of 2 % the resonance is a device's nominal motion or
    half a turn from it.
    """
    rng, errors, sds = np.random.default_rng(61_402), [], []
    true = np.angle(oscillator(1868.0, tolerance)[1])
    for _ in range(40):
        device, response = oscillator(1868.0 * (1.0 + 0.5 * tolerance * rng.normal()), tolerance)
        axis = track_drive_only(driven(device), device).axes["x"]
        assert axis.phase[0] == pytest.approx(np.angle(response), abs=0.02)
        errors.append(np.angle(response) - true)
        sds.append(axis.phase_sd[0])
    assert 0.7 < np.sqrt(np.mean(np.square(errors)) / np.mean(np.square(sds))) < 1.2
