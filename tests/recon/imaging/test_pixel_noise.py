"""Standard deviations of pixels: the noise model from repeated visits, and intervals that hold the true scene."""

from __future__ import annotations

import numpy as np
import pytest

from recon.imaging.gridding import map_samples
from recon.imaging.picture import Grid
from recon.imaging.pixel_noise import measure_noise, measure_sample_noise, pixel_sd
from scanner.angle_tracks import SampledAngle
from scanner.motion import AxisMotion, Motion
from scanner.recording import Recording

RATE_HZ = 1e6
GRID = Grid(60, 50, 0.1, 0.1)


def scan(photons: float, read_sd: float) -> tuple[Motion, Recording, np.ndarray]:
    """A scan of a scene that is constant within each pixel, with photon and read noise; the scene is the third item."""
    rng = np.random.default_rng(4)
    time = np.arange(200_000) / RATE_HZ
    theta = {"x": 0.0999 * np.sin(2 * np.pi * 1317.0 * time), "y": 0.0999 * np.sin(2 * np.pi * 233.0 * time)}
    scene = rng.uniform(0.2, 1.0, (GRID.height, GRID.width))
    column = np.clip(np.ceil(30 * (theta["x"] / 0.1 + 1)) - 1, 0, 59).astype(int)
    row = np.clip(np.ceil(25 * (theta["y"] / 0.1 + 1)) - 1, 0, 49).astype(int)
    intensity = rng.poisson(photons * scene[row, column]) + rng.normal(0.0, read_sd, time.size)
    still = np.zeros(2)
    axes = {name: AxisMotion(still, still, still, still, still, SampledAngle(theta[name], RATE_HZ)) for name in "xy"}
    recording = Recording.from_arrays({"intensity": (intensity, "1", RATE_HZ)})
    return Motion(axes, "sensor"), recording, photons * scene


@pytest.mark.parametrize(("photons", "read_sd"), [(200.0, 0.0), (20.0, 3.0), (2.0, 0.5), (0.1, 0.0)])
def test_intervals_of_pixels_hold_the_scene(photons: float, read_sd: float) -> None:
    motion, recording, scene = scan(photons, read_sd)
    channel = recording["intensity"]
    picture = map_samples(motion.axes["x"].angle.read(), motion.axes["y"].angle.read(), channel.read(), GRID)
    sd = pixel_sd(picture, measure_noise(motion, channel, GRID))
    visited = picture.coverage > 0
    assert np.array_equal(np.isfinite(sd), visited)
    held = np.abs(picture.image - scene)[visited] < 1.96 * sd[visited]
    assert 0.92 < held.mean() < 0.97


def test_the_noise_model_separates_photons_from_read_noise() -> None:
    rng = np.random.default_rng(1)
    pixel = np.tile(np.arange(2000), 20)
    level = rng.uniform(10.0, 100.0, 2000)[pixel]
    noise = measure_sample_noise(pixel, rng.poisson(level) + rng.normal(0.0, 5.0, pixel.size))
    assert noise is not None
    assert noise.slope == pytest.approx(1.0, abs=0.1)
    assert noise.variance(np.array(50.0)) == pytest.approx(75.0, rel=0.05)


def test_without_repeated_visits_there_is_no_noise_estimate() -> None:
    assert measure_sample_noise(np.arange(1000), np.ones(1000)) is None


def test_the_noise_of_few_pairs_is_not_biased() -> None:
    """Forty scenes with 1600 pairs each, 100 at a level of intensity."""
    rng = np.random.default_rng(5)
    pixel = np.tile(np.arange(1600), 2)
    ratios = []
    for _ in range(40):
        level = rng.uniform(1.0, 10.0, 1600)
        noise = measure_sample_noise(pixel, rng.poisson(level[pixel]).astype(float))
        assert noise is not None
        ratios.append(noise.variance(level).mean() / level.mean())
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.03)


def test_what_the_samples_of_a_crossing_share_is_noise_of_their_mean() -> None:
    """Ten samples in a crossing, whose mean varies by detail within the pixel from crossing to crossing."""
    rng = np.random.default_rng(6)
    crossed = np.tile(np.arange(500), 12)
    shared = rng.normal(0.0, 2.0, crossed.size)
    noise = measure_sample_noise(crossed.repeat(10), shared.repeat(10) + rng.normal(0.0, 1.0, 10 * crossed.size))
    assert noise is not None
    mean_variance = noise.variance(np.array(0.0)) / 10
    assert mean_variance == pytest.approx(2.0**2 + 0.1, rel=0.05)
    assert noise.relative_sd == pytest.approx(np.sqrt(2.0 / (500 * 11)), rel=0.3)


def test_noise_that_does_not_follow_the_intensity_is_right_in_the_mean() -> None:
    """Detail within the pixels is strong at medium intensity."""
    rng = np.random.default_rng(7)
    pixel = np.tile(np.arange(3000), 8)
    level = np.linspace(0.0, 100.0, 3000)
    sd = 1.0 + 4.0 * (np.abs(level - 50.0) < 15.0)
    noise = measure_sample_noise(pixel, level[pixel] + sd[pixel] * rng.normal(size=pixel.size))
    assert noise is not None
    assert noise.variance(level).mean() == pytest.approx(np.mean(sd**2), rel=0.05)
