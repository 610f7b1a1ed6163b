"""Hum and 1/f noise are noise of the readout, not a motion."""

from __future__ import annotations

import numpy as np
import pytest

from estimation.tracker import track
from estimation.tracker.block_signal import MIN_OFFSET_DENSITY_V2_PER_S
from estimation.tracker.demodulation import NoiseSpectrum, project_blocks, whiten_projections
from estimation.tracker.line_noise import (
    MAX_SPECTRUM_BLOCKS,
    initial_offset_density,
    line_noise_variance,
    noise_spectrum,
    shrink_to_white,
)
from scanner import devices
from scanner.channel import make_channel
from scanner.motion import Motion
from tests.support.simulated import noisy, with_sense

SAMPLE_RATE_HZ = 5e6


def tracked_with(added: np.ndarray) -> tuple[Motion, Motion]:
    """The motion from a noisy sense signal, without and with an addition [V]."""
    device = devices.load("imaging")
    return track(noisy(3), device), track(with_sense(noisy(3), lambda y: y + added), device)


def coloured_noise(corner_hz: float, sd: float, samples: int) -> np.ndarray:
    """Noise whose power falls with the frequency above a corner, shape (samples,) [V]."""
    frequency = np.fft.rfftfreq(samples, 1.0 / SAMPLE_RATE_HZ)
    white = np.fft.rfft(np.random.default_rng(4).standard_normal(samples))
    noise = np.fft.irfft(white / np.sqrt(1.0 + frequency / corner_hz), samples)
    return np.asarray(sd * noise / noise.std())


def line_noise_of(samples: np.ndarray, length: int, frequency_hz: float, lines: np.ndarray) -> np.ndarray:
    """Variances near the lines of noise of variance 1, shape (1 + lines,) [V^2]."""
    channel = make_channel("s", samples, unit="V", sample_rate=SAMPLE_RATE_HZ)
    starts = np.arange(samples.size // length) * length
    projections = project_blocks(channel, starts, length, lines, np.full((starts.size, 1), 2 * np.pi * frequency_hz))
    return line_noise_variance(projections, channel, starts, length, lines, 1.0)


def test_hum_is_not_attributed_to_the_amplitude() -> None:
    time = np.arange(noisy(3)["sense"].size) / SAMPLE_RATE_HZ
    hum = sum(np.sin(2.0 * np.pi * 50.0 * n * time + n) / n for n in (1, 2, 3))
    clean, changed = tracked_with(0.003 * hum)  # 0.6 % of the signal
    for name in "xy":
        scatter = np.std(np.log(changed.axes[name].amplitude / clean.axes[name].amplitude))
        assert scatter < 3e-4


@pytest.mark.parametrize("shape", ["ramp", "step"])
def test_an_offset_that_drifts_is_not_attributed_to_the_amplitude(shape: str) -> None:
    fraction = np.arange(noisy(3)["sense"].size) / noisy(3)["sense"].size
    clean, changed = tracked_with(0.1 * (fraction if shape == "ramp" else fraction > 0.45))  # 7 % of the signal
    for name in "xy":
        difference = np.log(changed.axes[name].amplitude / clean.axes[name].amplitude)
        assert np.abs(difference).max() < 2e-3  # tuned from the increments about their median alone: 0.05


def test_noise_of_low_frequency_is_not_attributed_to_the_motion() -> None:
    clean, changed = tracked_with(coloured_noise(100.0, 0.005, noisy(3)["sense"].size))
    for name, axis in changed.axes.items():
        assert np.degrees(np.std(axis.phase - clean.axes[name].phase)) < 0.016
        assert np.std(np.log(axis.amplitude / clean.axes[name].amplitude)) < 3e-4


def test_whitened_projections_of_coloured_noise_have_independent_errors() -> None:
    rng = np.random.default_rng(6)
    samples, white, by_line = 400, 0.8, np.array([3.0, 1.7, 0.8])
    time = np.arange(samples) - 0.5 * (samples - 1)
    rows = [np.ones(samples), *(part(2.0 * np.pi * f * time) for f in (0.0213, 0.0377) for part in (np.cos, np.sin))]
    table = np.stack(rows)
    spectrum = noise_spectrum(by_line, 1.0, samples)
    assert spectrum.white == 0.8
    coefficients = rng.normal(0.0, np.sqrt(spectrum.excess), (4000, 5))
    noise = np.sqrt(white) * rng.standard_normal((4000, samples)) + coefficients @ table
    for used in (slice(None), slice(0, 30)):  # a block with missing samples has the excess of a whole one
        grams = np.stack([table[:, used] @ table[:, used].T] * 3)[None]
        sums = noise[:, used] @ table[:, used].T
        whitened, moments, whiteners, solvers = whiten_projections(sums, grams, np.zeros(4000, int), spectrum)
        np.testing.assert_allclose(np.cov(whitened.T), np.eye(5), atol=0.1)
        truth = np.array([0.3, 1.0, -0.5, 0.2, 0.7])
        np.testing.assert_allclose(solvers[0] @ (moments[0, 0] @ truth), truth, rtol=1e-6)
        np.testing.assert_allclose(whiteners[0] @ grams[0, 0], moments[0, 0])
    flat = whiten_projections(sums, grams, np.zeros(4000, int), NoiseSpectrum(1.0, np.zeros(5)))
    np.testing.assert_allclose(flat[2][0] @ grams[0, 0] @ flat[2][0].T, np.eye(5), atol=1e-6)


def test_white_noise_has_one_variance_and_coloured_noise_keeps_its_own() -> None:
    length, frequency, lines = 2000, 13840.0, np.array([[0, 2], [0, 4], [0, 6]])
    noise = np.random.default_rng(8).standard_normal(MAX_SPECTRUM_BLOCKS * length)
    hum = coloured_noise(2e5, 1.0, noise.size)
    white, coloured = (line_noise_of(y, length, frequency, lines) for y in (noise, hum))
    error = 0.21  # standard deviation of the logarithm of one variance from 12 blocks
    np.testing.assert_allclose(white, 1.0, atol=error)  # without shrinkage, all four are with a probability of 0.2
    frequencies = np.append(3.5 * SAMPLE_RATE_HZ / length, frequency * lines[:, 1])
    full = np.linspace(0.0, SAMPLE_RATE_HZ / 2, 10000)
    density = 1.0 / (1.0 + frequencies / 2e5) / np.mean(1.0 / (1.0 + full / 2e5))
    np.testing.assert_allclose(np.log(coloured), np.log(density), atol=3 * error)


def test_a_block_of_two_thirds_of_a_cycle_does_not_determine_the_noise_near_its_lines() -> None:
    """The fit of lines and slips leaves no noise near the constant; what it leaves elsewhere is of few values."""
    length, lines = 1019, np.array([[0, 2], [0, 4], [0, 6], [0, 8]])
    frequency = 2.0 / 3.0 * SAMPLE_RATE_HZ / length
    for seed in range(20):
        noise = np.random.default_rng(seed).standard_normal(3 * length)
        np.testing.assert_allclose(line_noise_of(noise, length, frequency, lines), 1.0, atol=0.21)


def test_shrinkage_weighs_the_lines_by_their_errors() -> None:
    variance = np.full(5, 0.15**2)
    white = np.random.default_rng(2).normal(0.0, 0.15, (200, 5))
    shrunk = np.array([shrink_to_white(each, variance) for each in white])
    assert np.sqrt(np.mean(shrunk**2)) < 0.15 / 3
    clear = np.array([3.0, 2.0, 1.0, 0.5, 0.0])
    np.testing.assert_allclose(shrink_to_white(clear, variance), clear, atol=0.15)
    uncertain = shrink_to_white(clear, 100.0 * variance)
    assert np.all(uncertain <= shrink_to_white(clear, variance))


def test_a_steady_drift_of_the_mean_is_not_a_walk_of_the_offset() -> None:
    rng, blocks, length, step, noise_var = np.random.default_rng(5), 400, 2000, 4e-4, 1e-4
    noise = rng.normal(0.0, np.sqrt(noise_var / length), blocks)
    drift = 1e-2 * np.arange(blocks) / blocks
    at_rest = initial_offset_density(drift + noise, length, noise_var, step)
    assert at_rest == MIN_OFFSET_DENSITY_V2_PER_S
    density = 1e-3
    walk = np.cumsum(rng.normal(0.0, np.sqrt(density * step), blocks))
    found = initial_offset_density(walk + drift + noise, length, noise_var, step)
    assert abs(np.log(found / density)) < 4.0 * 2.33 / np.sqrt(blocks)  # the median of chi-square, four sigma
