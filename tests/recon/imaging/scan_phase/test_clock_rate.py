"""An intensity whose clock differs from that of the sensors, as of two instruments that record one scan."""

import re

import numpy as np
import pytest

import lissajous
from recon.pipeline import Reconstruction
from recon.report.picture_conclusion import conclude_reconstruction
from recon.report.summary import summarise

RATE, DURATION, HALF_ANGLE, PIXELS = 1e6, 0.1, 0.08, 200


def reconstruct(ppm: float, drift_x_rad: float = 0.0, duration: float = DURATION) -> Reconstruction:
    """A recording with angle channels whose intensity has a stated rate that is ``ppm`` too high.

    ``drift_x_rad`` is a phase by which the sensor of x alone is late at the end.
    """
    time = np.arange(round(RATE * duration)) / RATE
    x, y = 1.06 * np.sin(2 * np.pi * 2000.0 * time), 1.06 * np.sin(2 * np.pi * 835.0 * time + 1.0)
    spots = np.random.default_rng(1).uniform([-0.9, -0.9, 0.04], [0.9, 0.9, 0.12], (40, 3))
    scene = 0.3 + 0.1 * x + sum(np.exp(-((x - a) ** 2 + (y - b) ** 2) / (2 * w * w)) for a, b, w in spots)
    counts = np.random.default_rng(2).poisson(100.0 * scene)
    x = 1.06 * np.sin(2 * np.pi * 2000.0 * time - drift_x_rad * time / duration)
    angles = {f"angle_{name}": (HALF_ANGLE * u, "rad", RATE) for name, u in (("x", x), ("y", y))}
    device = lissajous.Device.from_toml(
        "[x.mechanics]\nJ = 1e-10\nb = 1e-8\nk = 0.0158\n[y.mechanics]\nJ = 1e-10\nb = 1e-8\nk = 0.00275\n"
        f"[scan]\nhalf_angle_x = {HALF_ANGLE}\nhalf_angle_y = {HALF_ANGLE}\n"
    )
    intensity = (counts, "counts", RATE * (1.0 + 1e-6 * ppm))
    recording = lissajous.Recording.from_arrays({**angles, "intensity": intensity}, device)
    return lissajous.reconstruct(recording, pixels=(PIXELS, PIXELS))


@pytest.mark.parametrize("ppm", [-50.0, 30.0, 100.0, 400.0])
def test_the_clock_error_and_the_true_rate_are_stated(ppm: float) -> None:
    result = reconstruct(ppm)
    [line] = [each for each in (*result.limits, *result.notes) if "ppm" in each]
    value, sd, rate = (float(each) for each in re.findall(r"\((\S+) ± (\S+)\) ppm.*state (\S+) Hz", line)[0])
    assert value == pytest.approx(ppm, abs=3 * sd)
    assert sd < 0.1 * abs(ppm)
    assert rate == pytest.approx(RATE, abs=3e-6 * sd * RATE)


def test_the_phase_sd_contains_a_clock_error_beyond_the_reach_of_the_registration() -> None:
    """The phase of x is 29 degrees late at the end of the scan, that of y 12 degrees."""
    result = reconstruct(400.0)
    for name, frequency in (("x", 2000.0), ("y", 835.0)):
        wrong = 360.0 * frequency * 400e-6 * DURATION / np.sqrt(3.0)
        assert np.degrees(np.sqrt(np.mean(result.motion.axes[name].phase_sd ** 2))) == pytest.approx(wrong, rel=0.1)


def test_the_conclusion_begins_with_a_clock_error_that_blurs_and_does_not_blame_noise() -> None:
    result = reconstruct(100.0)
    conclusion = conclude_reconstruction(summarise(result))
    assert conclusion.startswith("intensity: the phase errors of both axes grow")
    assert "noise of the position signals" not in conclusion


@pytest.mark.parametrize("drift_x_rad", [0.0, 0.03])
def test_a_right_clock_and_a_sensor_that_drifts_are_not_reported(drift_x_rad: float) -> None:
    result = reconstruct(0.0, drift_x_rad)
    assert not [each for each in (*result.limits, *result.notes) if "ppm" in each]


@pytest.mark.parametrize("duration", [0.04, 0.06])
def test_a_scan_of_one_or_two_slices_shows_it_in_their_parts(duration: float) -> None:
    result = reconstruct(80.0, duration=duration)
    [line] = [each for each in result.limits if "ppm" in each]
    value, sd = (float(each) for each in re.findall(r"\((\S+) ± (\S+)\) ppm", line)[0])
    assert value == pytest.approx(80.0, abs=3 * sd)
    for name, frequency in (("x", 2000.0), ("y", 835.0)):
        wrong = 360.0 * frequency * 80e-6 * duration / np.sqrt(12.0)
        stated = np.degrees(np.sqrt(np.mean(result.motion.axes[name].phase_sd ** 2)))
        assert 0.7 * wrong < stated < 2.0 * wrong


@pytest.mark.parametrize("duration", [0.02, 0.04, 0.06])
def test_a_short_scan_with_a_right_clock_or_a_sensor_that_drifts_is_not_reported(duration: float) -> None:
    for drift_x_rad in (0.0, 0.03):
        result = reconstruct(0.0, drift_x_rad, duration)
        assert not [each for each in (*result.limits, *result.notes) if "ppm" in each]
