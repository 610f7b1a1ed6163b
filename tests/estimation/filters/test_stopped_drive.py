"""Sample-by-sample filters on a mirror whose drive stops within the recording."""

from __future__ import annotations

import numpy as np
import pytest

from estimation.estimate import estimate
from scanner.device import Axis, Device
from scanner.motion import UNKNOWN_PHASE_SD_RAD
from scanner.recording import Recording
from scanner.stages import Drive, Mechanics, Velocity

F0_HZ, QUALITY, AMPLITUDE_RAD, VOLTAGE_V, INERTIA = 2000.0, 20.0, 0.1, 5.0, 1e-12
RATE = 2 * np.pi * F0_HZ
PERIODS, SAMPLES_PER_PERIOD = 1200, 50


def stopped_drive() -> tuple[Recording, np.ndarray]:
    """The recording, and the angle [rad]: a steady oscillation, and a free decay from half of the recording on."""
    k = INERTIA * RATE**2
    drive = Drive("linear", torque_per_volt=k * AMPLITUDE_RAD / QUALITY / VOLTAGE_V)
    readout = Velocity(gain=10.0 / RATE, noise_sd=0.01)
    axis = Axis(Mechanics(INERTIA, INERTIA * RATE / QUALITY, k), drive=drive, readout=readout, name="x")
    n = PERIODS * SAMPLES_PER_PERIOD
    time = np.arange(n) / (SAMPLES_PER_PERIOD * F0_HZ)
    loss = RATE / (2 * QUALITY)
    free, after = np.sqrt(RATE**2 - loss**2), time - time[n // 2]
    on, decay = after < 0.0, np.exp(-loss * np.maximum(after, 0.0))
    falling = -AMPLITUDE_RAD * decay * (np.cos(free * after) + loss / free * np.sin(free * after))
    angle = np.where(on, -AMPLITUDE_RAD * np.cos(RATE * time), falling)
    falling_rate = AMPLITUDE_RAD * decay * RATE**2 / free * np.sin(free * after)
    rate = np.where(on, AMPLITUDE_RAD * RATE * np.sin(RATE * time), falling_rate)
    sense = readout.gain * rate + readout.noise_sd * np.random.default_rng(0).normal(size=n)
    voltage = np.where(on, VOLTAGE_V * np.sin(RATE * time), 0.0)
    fs = SAMPLES_PER_PERIOD * F0_HZ
    channels = {"drive_x": (voltage, "V", fs), "sense_x": (sense, "V", fs)}
    return Recording.from_arrays(channels, Device("stopped", {"x": axis})), angle


@pytest.mark.parametrize("method", ["ekf", "ukf"])
def test_rest_after_the_drive_adds_no_third_harmonic_to_the_motion_before(method: str) -> None:
    """Noise over an amplitude of nearly 0 was a third harmonic of 2 % of the amplitude in the whole recording."""
    recording, angle = stopped_drive()
    driven = slice(angle.size // 10, angle.size * 4 // 10)
    error = estimate(recording, recording.device, method).axes["x"].angle.read()[driven] - angle[driven]
    assert np.std(error) < 2e-3 * AMPLITUDE_RAD


def test_the_phase_of_a_mirror_at_rest_is_unknown_and_no_less_than_that() -> None:
    """Its standard deviation was up to 36 rad here, more than that of a phase of which nothing is known."""
    recording, _ = stopped_drive()
    phase_sd = estimate(recording, recording.device, "ekf").axes["x"].phase_sd
    assert phase_sd[-1] == phase_sd.max() == UNKNOWN_PHASE_SD_RAD


@pytest.mark.parametrize("method", ["ekf", "ukf"])
def test_the_amplitude_of_a_fast_decay_is_that_at_the_centre_of_its_block(method: str) -> None:
    """The mean over four periods of a decay with a Q of 20 was 0.7 % above it."""
    recording, _ = stopped_drive()
    motion = estimate(recording, recording.device, method).axes["x"]
    after = motion.time - PERIODS // 2 / F0_HZ
    decay = (after > 6.0 / F0_HZ) & (after < 20.0 / F0_HZ)
    expected = AMPLITUDE_RAD * np.exp(-RATE / (2 * QUALITY) * after[decay])
    assert np.abs(motion.amplitude[decay] / expected - 1.0).max() < 4e-3
