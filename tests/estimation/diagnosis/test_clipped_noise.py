"""A clipped signal has no noise where it stands at its rail."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import chirp, lsim

from estimation.complete_diagnosis import diagnose_with_optics
from estimation.device_fit.noise import make_whitener, noise_psd
from scanner.arrays import Array
from scanner.device import Axis, Device
from scanner.recording import Recording
from scanner.stages import Drive, Mechanics, Velocity

RATE, RESONANCE, QUALITY, J = 20400.0, 850.0, 40.0, 2e-10
FINE = 16  # steps in a sample, between which the solution is linear
W = 2 * np.pi * RESONANCE
MECHANICS = Mechanics(J, J * W / QUALITY, J * W**2)
TORQUE = MECHANICS.k / QUALITY * 0.1


def clipped_sweep(limit: float, seed: int) -> Recording:
    """A sweep over the resonance whose velocity signal, with white noise of 2 mV, is clipped at ``limit`` [V]."""
    time = np.arange(FINE * int(0.3 * RATE)) / (FINE * RATE)
    drive = 3.0 * chirp(time, 600.0, 0.3, 1150.0, phi=-90.0)
    rate = lsim(([TORQUE / J, 0.0], [1.0, MECHANICS.b / J, W**2]), drive, time)[1][::FINE]
    noise = 2e-3 * np.random.default_rng(seed).normal(size=rate.size)
    axis = Axis(MECHANICS, drive=Drive("linear", TORQUE), readout=Velocity(4e-3, 0.0, 2e-3), name="x")
    signal = np.clip(4e-3 * rate + noise, -limit, limit)
    channels = {"drive_x": (drive[::FINE], "V", RATE), "sense_x": (signal, "V", RATE)}
    return Recording.from_arrays(channels, Device("a", {"x": axis}))


@pytest.mark.parametrize(("limit", "seed"), [(0.2, 3), (1.2, 4)])
def test_a_signal_that_is_only_clipped_has_no_other_finding(limit: float, seed: int) -> None:
    """Noise was the mean over clipped samples too: with a limit of 0.2 V a misfit of 1.4 times the noise was left, with
    1.2 V one of 1.2 times. With another start of the sweep an unknown law of the drive was found (p = 1.0)."""
    found = diagnose_with_optics([clipped_sweep(limit, seed)])
    assert [finding.effect for finding in found.findings] == ["saturation"]
    assert (found.unexplained, found.remainder) == (None, None)


def test_the_noise_of_the_samples_that_have_some_is_measured() -> None:
    rng = np.random.default_rng(1)
    share: Array = np.repeat([1.0, 0.0, 1.0, 0.5], 5000)
    residual = rng.normal(size=share.size) * np.sqrt(share)
    psd, first = noise_psd(residual, share.size // 2, 1e-4, [], 0.0, share)
    assert np.median(psd) == pytest.approx(share.size, rel=0.05)
    whitener = make_whitener(psd, share.size, (0, 0), first, share)
    chi2 = np.sum(whitener(residual) ** 2)
    assert chi2 == pytest.approx(np.sum(whitener.noisy_share), rel=0.05)
