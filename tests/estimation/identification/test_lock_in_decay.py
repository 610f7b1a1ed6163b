"""Free decays behind a lock-in amplifier: intervals beside noise that its filter correlates."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from estimation.identification.lock_in_decay import fit_lock_in_decay
from scanner.device import Axis, Device
from scanner.recording import Recording
from scanner.stages import Mechanics

W, QUALITY, TIME_CONSTANT_S = 2.0 * np.pi * 2000.0, 5000.0, 1e-2


def pulls(rate: float, seed: int) -> list[float]:
    """Errors of k/J and b/J in standard deviations, with noise of 1 % behind four low-passes."""
    mechanics, rng = Mechanics(1e-12, 1e-12 * W / QUALITY, 1e-12 * W**2), np.random.default_rng(seed)
    time, settle = np.arange(round(2.0 * rate)) / rate, round(20.0 * TIME_CONSTANT_S * rate)
    noise = rng.standard_normal(time.size + settle) + 1j * rng.standard_normal(time.size + settle)
    pole = np.exp(-1.0 / (rate * TIME_CONSTANT_S))
    for _ in range(4):
        noise = lfilter([1.0 - pole], [1.0, -pole], noise)
    decay, detuning = 0.5 * W / QUALITY, 20.0
    values = np.exp((1j * detuning - decay) * time) + 0.01 * noise[settle:] / np.std(noise[settle:])
    about = (rate, 0.0, {"reference": 2000.0})
    channels = {"amplitude_x": (np.abs(values), "V", *about), "phase_x": (np.angle(values), "rad", *about)}
    axis = Axis(mechanics, name="x")
    found = fit_lock_in_decay(Recording.from_arrays(channels, Device("membrane", {"x": axis})), axis)
    true = {"k_over_J": (W + detuning) ** 2 + decay**2, "b_over_J": 2.0 * decay}
    return [(found[key].value - value) / found[key].sd for key, value in true.items()]


@pytest.mark.parametrize("samples_a_time_constant", [2.0, 500.0])
def test_intervals_have_the_size_of_the_errors_at_any_rate_of_the_output(samples_a_time_constant: float) -> None:
    """With 500 samples in the time constant the errors were 2.1 standard deviations, with 2 they were 0.6."""
    found = [pulls(samples_a_time_constant / TIME_CONSTANT_S, seed) for seed in range(12)]
    assert np.sqrt(np.mean(np.square(found))) == pytest.approx(1.0, abs=0.4)
