"""Hum of a position sensor is subtracted where the drive does not cause it; what moves the mirror is kept."""

from __future__ import annotations

import numpy as np
import pytest

from estimation.filters.baselines import estimate_from_sensor
from estimation.sensor_hum import find_lines
from recon.pipeline import reconstruct
from recon.steps.reconstruction import Options, Reconstruction
from scanner.device import Axis, Device
from scanner.device_templates import KnownAxis, new_device
from scanner.recording import Recording
from scanner.stages import Drive, Mechanics, Position

RATE_HZ = 2e5
TIME = np.arange(16_000) / RATE_HZ
FREQUENCIES_HZ = {"x": 2000.0, "y": 835.0}
DEVICE = Device.from_toml(new_device("electromagnetic", {name: KnownAxis(f) for name, f in FREQUENCIES_HZ.items()}))
CENTRES_S = np.arange(400) / 2000.0


def scan(hum: np.ndarray, driven: np.ndarray, drives: bool = True) -> tuple[Recording, dict[str, np.ndarray]]:
    """A steady scan and the angles of the mirror; both sensors add ``hum``, and a slow drive moves both by ``driven``.

    Both are fractions of the half angle.
    """
    rng, channels, angles, light = np.random.default_rng(8), {}, {}, np.ones(TIME.size)
    assert DEVICE.scan is not None
    for name, half in (("x", DEVICE.scan.half_angle_x), ("y", DEVICE.scan.half_angle_y)):
        axis, turn = DEVICE.axis(name), 2.0 * np.pi * FREQUENCIES_HZ[name]
        assert axis.mechanics is not None
        assert axis.drive is not None
        assert axis.drive.torque_per_volt is not None
        angles[name] = half * (0.9 * np.sin(turn * TIME) + driven)
        torque = 0.9 * half * axis.mechanics.b * turn * np.cos(turn * TIME) + axis.mechanics.k * half * driven
        sensed = angles[name] + half * hum + 1e-4 * half * rng.standard_normal(TIME.size)
        channels[f"angle_{name}"] = (sensed, "rad", RATE_HZ)
        if drives:
            channels[f"drive_{name}"] = (torque / axis.drive.torque_per_volt, "V", RATE_HZ)
        light = light * (1.0 + 0.5 * np.sin(9.0 * angles[name] / half + 2.0))
    channels["intensity"] = (rng.poisson(200 * light).astype(float), "count", RATE_HZ)
    return Recording.from_arrays(channels, DEVICE), angles


def sine(frequency: float, amplitude: float) -> np.ndarray:
    return amplitude * np.sin(2.0 * np.pi * frequency * TIME + 0.4)


@pytest.mark.parametrize(
    ("hum", "driven"),
    [
        (sine(50.0, 0.06), 0.0 * TIME),
        (sine(50.0, 0.02) + sine(100.0, 0.008) + sine(150.0, 0.004), 0.0 * TIME),
        (sine(50.0, 0.02), sine(30.0, 0.05)),
        (0.0 * TIME, sine(50.0, 0.05)),
        (0.0 * TIME, 0.0 * TIME),
    ],
    ids=["mains", "harmonics", "beside a slow drive", "hum of the drive", "none"],
)
@pytest.mark.filterwarnings("error")
def test_the_angle_is_that_of_the_mirror_in_spite_of_hum(hum: np.ndarray, driven: np.ndarray) -> None:
    recording, angles = scan(hum, driven)
    motion = estimate_from_sensor(recording, DEVICE)
    for name, angle in angles.items():
        error = motion.axes[name].angle.read(0, TIME.size) - angle
        assert np.sqrt(np.mean(error**2)) < 2.5e-4 * np.ptp(angle) / 2.0
    assert len([note for note in motion.notes if "hum of the sensor" in note]) == (2 if hum.any() else 0)


def reconstruction(hum: np.ndarray, drives: bool) -> Reconstruction:
    recording, _ = scan(hum, 0.0 * TIME, drives)
    return reconstruct(recording, Options(pixels=(100, 100), estimator="sensor", allow_outside=True), quiet=True)


def test_the_line_is_stated_with_its_frequency_and_size() -> None:
    result = reconstruction(sine(50.0, 0.08), drives=True)
    assert result.limits == []
    assert any(note.startswith("angle_x: holds a line at 50 Hz with an amplitude of") for note in result.notes)


def test_hum_is_no_motion_of_the_sample_where_no_drive_was_recorded() -> None:
    first, second = reconstruction(sine(50.0, 0.08), drives=False).limits
    assert first.startswith("x: the position signal holds a line at 50 Hz, ±4 pixels, and the picture shows")
    assert second.startswith("y: ")


@pytest.mark.parametrize(
    "values",
    [
        np.random.default_rng(1).standard_normal(CENTRES_S.size),
        np.cumsum(np.random.default_rng(2).standard_normal(CENTRES_S.size)),
        np.exp(-CENTRES_S / 0.05),
        CENTRES_S**2,
        np.where(CENTRES_S < 0.07, 0.0, 1.0),
        np.zeros(CENTRES_S.size),
        np.ones(CENTRES_S.size),
        np.full(CENTRES_S.size, 1e300),
        np.random.default_rng(3).standard_normal(9)[:9],
        np.zeros(0),
    ],
    ids=["noise", "walk", "exponential", "parabola", "step", "zero", "constant", "large", "few", "none"],
)
@pytest.mark.filterwarnings("error")
def test_noise_and_drifts_are_no_lines(values: np.ndarray) -> None:
    assert find_lines(CENTRES_S[: values.size], values, 160.0, 0.0) == []


def test_lines_are_found_beside_noise_and_no_smaller_one_than_the_motion_changes() -> None:
    noise = 0.1 * np.random.default_rng(4).standard_normal(CENTRES_S.size)
    values = np.sin(2.0 * np.pi * 50.2 * CENTRES_S + 1.0) + 0.4 * np.cos(2.0 * np.pi * 99.0 * CENTRES_S) + noise
    strong, weak = find_lines(CENTRES_S, values, 160.0, 0.0)
    assert (strong.frequency, weak.frequency) == (pytest.approx(50.2, abs=0.05), pytest.approx(99.0, abs=0.1))
    assert (strong.amplitude, weak.amplitude) == (pytest.approx(1.0, abs=0.03), pytest.approx(0.4, abs=0.03))
    assert len(find_lines(CENTRES_S, values, 160.0, 0.5)) == 1


@pytest.mark.parametrize("samples_per_period", [8.5, 12.5, 20.4])
def test_a_period_of_no_whole_number_of_samples_shows_no_hum(samples_per_period: float) -> None:
    """A line of 2.4 % of the amplitude was found beside 8.5 samples a period, and was subtracted."""
    frequency, amplitude, quality, inertia = 2000.0, 0.1, 100.0, 1e-12
    rate = samples_per_period * frequency
    time, w = np.arange(round(0.6 * rate)) / rate, 2.0 * np.pi * frequency
    drive = Drive("linear", torque_per_volt=inertia * w**2 * amplitude / quality)
    readout = Position(gain=10.0, noise_sd=0.002)
    axis = Axis(Mechanics(inertia, inertia * w / quality, inertia * w**2), drive=drive, readout=readout, name="x")
    angle, noise = -amplitude * np.cos(w * time), np.random.default_rng(0).normal(0.0, 0.002, time.size)
    channels = {"drive_x": (np.sin(w * time), "V", rate), "sense_x": (10.0 * angle + noise, "V", rate)}
    device = Device("steady", {"x": axis})
    motion = estimate_from_sensor(Recording.from_arrays(channels, device), device)
    assert not motion.notes
    assert np.std(motion.axes["x"].angle.read() - angle) < 1.1 * 0.0002
