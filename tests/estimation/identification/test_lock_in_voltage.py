"""Amplitude and phase of a lock-in amplifier that are those of the voltage of a sensor of the motion."""

from __future__ import annotations

import numpy as np
import pytest

from estimation.filters.baselines import estimate_from_sensor
from estimation.identification.calibrate import identify
from phantoms.forward import InitialState, Plan, simulate
from phantoms.waveforms import Sweep
from scanner.device import Axis, Device
from scanner.recording import Recording
from scanner.stages import Acceleration, Drive, Mechanics, MotionSensor, Position, Velocity

RATE, RESONANCE_HZ, QUALITY, INERTIA = 5e4, 1000.0, 50.0, 1e-10
W = 2 * np.pi * RESONANCE_HZ
SENSORS = [
    Position(10.0, 0.01),
    Position(-10.0, 0.01),
    Velocity(10.0 / W, 0.01),
    Acceleration(10.0 / W**2, 0.01),
]


def device(readout: MotionSensor, inertia: float = INERTIA) -> Device:
    mechanics = Mechanics(inertia, inertia * W / QUALITY, inertia * W**2)
    axis = Axis(mechanics, drive=Drive("linear", 1e-7), readout=readout, name="x", tolerance={"gain": 0.05})
    return Device("mirror", {"x": axis})


@pytest.mark.parametrize("readout", SENSORS, ids=lambda each: f"{each.kind} {np.sign(each.gain):+.0f}")
def test_the_angle_is_that_of_the_motion(readout: MotionSensor) -> None:
    """It was a right angle of phase behind a velocity sensor, and half a turn where the gain is negative."""
    motion_hz, slow, time = 1020.0, np.ones(200), np.arange(20_000) / 1e5
    volts = 0.1 * np.exp(0.3j) * readout.gain * (2j * np.pi * motion_hz) ** readout.order * slow
    about = (1e3, 0.0, {"reference": motion_hz})
    channels = {
        "intensity": (time, "V", 1e5),
        "amplitude_x": (np.abs(volts), "V", *about),
        "phase_x": (np.angle(volts), "rad", *about),
    }
    found = estimate_from_sensor(Recording.from_arrays(channels), device(readout))
    angle = found.axes["x"].angle.read()
    assert np.abs(angle - 0.1 * np.sin(2 * np.pi * motion_hz * time + 0.3))[: 199 * 100].max() < 1e-6


def swept(readout: MotionSensor) -> Recording:
    """Drive, and amplitude and phase of the voltage against the resonance."""
    plan = Plan({"x": Sweep(950.0, 1050.0, 0.4, 10.0)}, 0.4, RATE)
    made, _ = simulate(device(readout), plan, start={"x": InitialState(0.0, 0.0)}, seed=4)
    sense, length = made["sense_x"], 25
    mixed = 2j * sense.read() * np.exp(-1j * W * sense.time())
    phasor = mixed.reshape(-1, length).mean(axis=1)
    about = (RATE / length, 0.5 * (length - 1) / RATE, {"reference": RESONANCE_HZ})
    channels = {
        "drive_x": (made["drive_x"].read(), "V", RATE),
        "amplitude_x": (np.abs(phasor), "V", *about),
        "phase_x": (np.angle(phasor), "rad", *about),
    }
    return Recording.from_arrays(channels)


@pytest.mark.parametrize("readout", SENSORS, ids=lambda each: f"{each.kind} {np.sign(each.gain):+.0f}")
def test_a_sweep_determines_the_mechanics(readout: MotionSensor) -> None:
    found = identify([swept(readout)], device(readout, 1.2 * INERTIA)).values["x"]
    true = {"k_over_J": W**2, "b_over_J": W / QUALITY}
    for key, value in true.items():
        assert found[key].value == pytest.approx(value, abs=4.5 * found[key].sd)
        assert found[key].sd < 0.01 * value
    assert found["J"].value == pytest.approx(INERTIA, rel=5e-3)
    assert found["J"].sd / INERTIA == pytest.approx(np.hypot(0.02, 0.05), rel=0.05)  # of the torque and the gain
