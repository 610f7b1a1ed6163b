"""The angle of the estimator `sensor`: little memory, any clock, readable without the file."""

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from estimation.estimate import estimate
from estimation.filters import measured_motion
from scanner.device import Axis, Device
from scanner.recording import Recording

SENSOR = Device("sensor", {"x": Axis(name="x")})


def peak_bytes_of_sensor(samples: int) -> int:
    """Largest memory that the estimator `sensor` holds beside the samples of one 16-bit channel."""
    turn = 2 * np.pi * 0.01 * np.arange(samples)
    values = np.round(3e4 * np.sin(turn, out=turn), out=turn).astype(np.int16)
    del turn
    recording = Recording.from_arrays({"angle_x": (values, "rad", 1e6)})
    tracemalloc.start()
    try:
        motion = estimate(recording, SENSOR, "sensor")
        assert motion.axes["x"].angle.advanced(np.array([0.0, 9.0]), np.ones(2), np.full(2, 1e4)).size == samples
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_sensor_estimator_holds_no_angle_of_every_sample() -> None:
    long, longer = peak_bytes_of_sensor(6_000_000), peak_bytes_of_sensor(12_000_000)
    assert longer - long < 2 * 6_000_000, "an angle of every sample takes eight bytes"


def test_angles_of_the_sensor_are_read_after_the_file_was_closed(tmp_path: Path) -> None:
    values = np.round(3e4 * np.sin(2 * np.pi * 0.01 * np.arange(5000))).astype(np.int16)
    Recording.from_arrays({"angle_x": (values, "rad", 1e6)}).write(tmp_path / "scan.h5")
    with Recording.open(tmp_path / "scan.h5") as opened:
        angle = estimate(opened, SENSOR, "sensor").axes["x"].angle
    np.testing.assert_array_equal(angle.read(), values)


def on_another_clock(samples_a_period: float, rate: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Angles at the samples of an intensity, their true values without noise, and the times."""
    turn = 2 * np.pi * 1e5 / samples_a_period
    values = np.sin(turn * np.arange(5000) / 1e5 + 0.4) + 1e-4 * np.random.default_rng(0).standard_normal(5000)
    light, start = np.ones(round(0.08 * rate)), -0.0100017
    recording = Recording.from_arrays({"angle_x": (values, "rad", 1e5), "intensity": (light, "V", rate, start)})
    time = start + np.arange(light.size) / rate
    return estimate(recording, SENSOR, "sensor").axes["x"].angle.read(), np.sin(turn * time + 0.4), time


@pytest.mark.parametrize("rate", [2.5e5, 1e5, 3e4])
@pytest.mark.parametrize("samples_a_period", [2.7, 6.4, 33.0])
def test_angles_on_another_clock_are_those_of_the_motion(samples_a_period: float, rate: float) -> None:
    angle, true, time = on_another_clock(samples_a_period, rate)
    inside = (time >= 0.0) & (time <= 0.05)
    assert np.abs(angle - true)[inside].max() < 1e-3
    assert np.isnan(angle[~inside]).all()


def test_parts_on_another_clock_are_those_of_one_spline(monkeypatch: pytest.MonkeyPatch) -> None:
    whole, _, _ = on_another_clock(33.0, 2.5e5)
    monkeypatch.setattr(measured_motion, "READ_CHUNK_SAMPLES", 777)
    np.testing.assert_allclose(on_another_clock(33.0, 2.5e5)[0], whole, atol=1e-12)
