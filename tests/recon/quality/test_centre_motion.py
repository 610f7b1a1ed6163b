"""A centre of a resonant motion that moves in a position signal without a torque leads the conclusion."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

from recon.pipeline import reconstruct
from recon.steps.reconstruction import Options
from scanner.device import Device
from scanner.device_templates import KnownAxis, new_device
from scanner.recording import Recording

RATE_HZ = 2e5
TIME_S = np.arange(20_000) / RATE_HZ
DEVICE = Device.from_toml(new_device("electromagnetic", {"x": KnownAxis(2000.0), "y": KnownAxis(835.0)}))


def scan(
    drift_rad: float = 0.0, slow_drive: float = 0.0, noise_rad: float = 1e-5,
    crosstalk: tuple[float, float] = (0.0, 0.0), device: Device = DEVICE,
) -> list[str]:  # fmt: skip
    """Limits of a scan from rest, of amplitudes that fill the field; drift of the sensor and a slow drive are in x.

    The sensors of x and y hold ``crosstalk`` times the other angle.
    """
    assert DEVICE.scan is not None
    rng, channels, angles = np.random.default_rng(5), {}, []
    for name, frequency, half_angle in (
        ("x", 2000.0, DEVICE.scan.half_angle_x),
        ("y", 835.0, DEVICE.scan.half_angle_y),
    ):
        axis = DEVICE.axis(name)
        assert axis.mechanics is not None
        assert axis.drive is not None
        m, torque = axis.mechanics, axis.drive.torque_per_volt
        assert torque is not None
        volts = half_angle * m.b * 2 * np.pi * frequency / torque * np.sin(2 * np.pi * frequency * TIME_S)
        if name == "x":
            volts = volts + slow_drive * half_angle * m.k / torque * np.sin(2 * np.pi * 30.0 * TIME_S)
        system = cont2discrete(([1 / m.J], [1, m.b / m.J, m.k / m.J]), 1 / RATE_HZ)
        angle = lfilter(system[0].ravel(), system[1], torque * volts)
        angles.append(angle / half_angle)
        drift = drift_rad * np.sqrt(1.5) * np.linspace(-1.0, 1.0, TIME_S.size) if name == "x" else 0.0
        noise = rng.normal(0.0, noise_rad, TIME_S.size)
        channels |= {f"drive_{name}": (volts, "V", RATE_HZ), f"angle_{name}": (angle + drift + noise, "rad", RATE_HZ)}
    x, y = angles
    for name, other, factor, half_angle in (
        ("x", y, crosstalk[0], DEVICE.scan.half_angle_y),
        ("y", x, crosstalk[1], DEVICE.scan.half_angle_x),
    ):
        values, *about = channels[f"angle_{name}"]
        channels[f"angle_{name}"] = (values + factor * half_angle * other, *about)
    light = 1.0 + 0.5 * np.sin(9.0 * x + 2.0) * np.cos(7.0 * y) + 0.3 * x
    recording = Recording.from_arrays({**channels, "intensity": (rng.poisson(500 * light) / 500, "V", RATE_HZ)}, device)
    return reconstruct(recording, Options(estimator="sensor", pixels=(80, 80), allow_outside=True), quiet=True).limits


def test_a_drift_of_a_position_signal_is_stated_with_its_size() -> None:
    assert DEVICE.scan is not None
    drift = 3.0 * 2.0 * DEVICE.scan.half_angle_x / 80  # three pixels
    (line,) = (line for line in scan(drift_rad=drift) if "centre" in line)
    assert line.startswith("x: the centre of the motion moves by ±3 pixels, most at 10")


@pytest.mark.parametrize(("crosstalk", "name"), [((0.05, 0.0), "x"), ((0.0, -0.05), "y")])
def test_crosstalk_of_the_other_axis_is_no_hum(crosstalk: tuple[float, float], name: str) -> None:
    (line,) = (line for line in scan(crosstalk=crosstalk) if "centre" in line or "follows" in line)
    other = "y" if name == "x" else "x"
    stated = re.match(rf"{name}: the position signal follows {other} by the factor (\S+), ±(\S+) pixels", line)
    assert stated is not None
    assert float(stated[1]) == pytest.approx(sum(crosstalk), abs=1e-3)
    assert float(stated[2]) == pytest.approx(2.0, abs=0.25)  # the amplitude still grows


def test_crosstalk_that_the_device_states_is_subtracted() -> None:
    terms = {"sensor-crosstalk": {"c": 0.05, "variant": 1}}
    stated = replace(DEVICE, axes=dict(DEVICE.axes) | {"x": replace(DEVICE.axis("x"), terms=terms)})
    assert not any("follows" in line for line in scan(crosstalk=(0.05, 0.0), device=stated))


def test_crosstalk_and_a_drift_are_stated_both() -> None:
    assert DEVICE.scan is not None
    drift = 3.0 * 2.0 * DEVICE.scan.half_angle_x / 80
    lines = [line for line in scan(drift_rad=drift, crosstalk=(0.05, 0.0)) if "centre" in line or "follows" in line]
    assert [("follows" in line, "most at 10" in line) for line in lines] == [(True, False), (False, True)]


@pytest.mark.parametrize("change", [{}, {"slow_drive": 0.3}, {"noise_rad": 5e-3}])
def test_a_start_from_rest_a_slow_drive_and_noise_are_no_error_of_the_sensor(change: dict[str, float]) -> None:
    assert not any("centre" in line or "follows" in line for line in scan(**change))


def test_a_slow_axis_beside_a_resonant_one_is_no_crosstalk() -> None:
    rng, scans = np.random.default_rng(6), {"x": (8000.0, 1.0), "y": (40.0, 0.95)}
    assert DEVICE.scan is not None
    half, time = DEVICE.scan.half_angle_x, np.arange(200_000) / 2e6
    angles = {name: share * half * np.sin(2 * np.pi * f * time) for name, (f, share) in scans.items()}
    channels = {f"angle_{n}": (a + rng.normal(0.0, 1e-4, time.size), "rad", 2e6) for n, a in angles.items()}
    light = 1.0 + 0.5 * np.sin(9.0 * angles["x"] / half + 2.0) * np.cos(7.0 * angles["y"] / half)
    recording = Recording.from_arrays({**channels, "intensity": (rng.poisson(500 * light) / 500, "V", 2e6)}, DEVICE)
    limits = reconstruct(recording, Options(estimator="sensor", pixels=(80, 80)), quiet=True).limits
    assert not any("follows" in line or "centre" in line for line in limits)
