"""Hum and 1/f noise are noise of the readout, not a motion."""

from __future__ import annotations

import numpy as np

from estimation.tracker import track
from estimation.tracker.demodulation import NoiseSpectrum, whiten_projections
from estimation.tracker.line_noise import noise_spectrum
from scanner import devices
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


def test_hum_is_not_attributed_to_the_amplitude() -> None:
    time = np.arange(noisy(3)["sense"].size) / SAMPLE_RATE_HZ
    hum = sum(np.sin(2.0 * np.pi * 50.0 * n * time + n) / n for n in (1, 2, 3))
    clean, changed = tracked_with(0.003 * hum)  # 0.6 % of the signal
    for name in "xy":
        scatter = np.std(np.log(changed.axes[name].amplitude / clean.axes[name].amplitude))
        assert scatter < 3e-4


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
