"""Tuned process noise of the filters where the model explains the recording."""

from __future__ import annotations

import numpy as np

from estimation.estimate import estimate
from phantoms.forward import InitialState, Plan, simulate
from phantoms.waveforms import Sine
from scanner.device import Axis, Device
from scanner.stages import Drive, Mechanics, Velocity

F0_HZ, QUALITY, AMPLITUDE_RAD, VOLTAGE_V, INERTIA = 1e5, 20.0, 0.1, 5.0, 1e-12


def test_the_stated_phase_error_does_not_vanish_where_a_lower_process_noise_is_no_more_likely() -> None:
    """The search went on for gains of 1e-3: an error of 0.01 degrees was stated as 1e-7 degrees."""
    rate, fs = 2 * np.pi * F0_HZ, 50 * F0_HZ
    k = INERTIA * rate**2
    drive = Drive("linear", torque_per_volt=k * AMPLITUDE_RAD / QUALITY / VOLTAGE_V)
    readout = Velocity(gain=10.0 / rate, noise_sd=0.01)
    axis = Axis(Mechanics(INERTIA, INERTIA * rate / QUALITY, k), drive=drive, readout=readout, name="x")
    waves = {"x": Sine(F0_HZ, VOLTAGE_V, 0.0)}
    plan = Plan(waves, 400 / F0_HZ, sample_rate=fs, settle=0.0, references=("angle",), sense_range=5.0)
    start = {"x": InitialState(0.0, AMPLITUDE_RAD * rate)}
    recording, _ = simulate(Device("resonator", {"x": axis}), plan, start=start, seed=3)
    motion = estimate(recording.without_channel("angle_x"), recording.device, "ekf").axes["x"]
    steady = slice(recording["angle_x"].size // 2, None)
    error = motion.angle.read()[steady] - recording["angle_x"].read()[steady]
    found = np.sqrt(2.0) * np.std(error) / AMPLITUDE_RAD
    assert 0.5 * found < np.median(motion.phase_sd) < 3.0 * found
