"""A position sensor whose noise the device file states too low, and one with missing samples."""

import numpy as np
import pytest

from estimation.filters.baselines import estimate_from_sensor
from scanner.device import Device
from scanner.recording import Recording

GAIN, STATED_SD = 20.0, 2e-3
"""Of the device file [V/rad], [V]."""


@pytest.mark.parametrize(("noise_sd", "noted"), [(2e-3, False), (0.04, True), (2e-4, False)])
def test_noise_above_the_stated_one_is_measured_and_noted(noise_sd: float, noted: bool) -> None:
    """The noise in single samples is the larger of the stated and the measured one."""
    rate, time = 1e6, np.arange(50_000) / 1e6
    noise = np.random.default_rng(0).normal(0.0, noise_sd, time.size)
    device = Device.from_toml(f'[x.readout]\nkind = "position"\ngain = {GAIN}\nnoise_sd = {STATED_SD}\n')
    signal = GAIN * 0.1 * np.sin(2 * np.pi * 2000.0 * time) + noise
    motion = estimate_from_sensor(Recording.from_arrays({"sense_x": (signal, "V", rate)}, device), device)
    assert motion.axes["x"].angle_noise_sd == pytest.approx(max(noise_sd, STATED_SD) / GAIN, rel=0.05)
    assert any("states noise_sd = 0.002" in note for note in motion.notes) == noted
