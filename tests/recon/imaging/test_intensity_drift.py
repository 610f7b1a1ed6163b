"""The drift of a detector, solved through crossings of a scan with a known answer."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from recon.cli import main
from recon.imaging.intensity_drift import IntensityDrift, estimate_intensity_drift, fit_drift_model
from recon.imaging.intensity_drift_equations import DriftKind, SceneSums
from recon.imaging.pixel_noise import measure_sample_noise
from tests.support.simulated import imaging

RATE, PIXELS, NOISE_SD = 5e6, 200, 0.1


def crossing_scan(duration: float, pixels: int = PIXELS) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of a scan at 4100 and 5378 Hz, and the value of a scene with detail at each sample."""
    time = np.arange(round(duration * RATE)) / RATE
    column, row = (
        np.clip(((np.sin(2 * np.pi * f * time) + 1) / 2 * pixels).astype(int), 0, pixels - 1) for f in (4100.3, 5377.7)
    )
    pixel = (row * pixels + column).astype(np.int32)
    scene = np.random.default_rng(0).uniform(0.2, 1.0, pixels**2)
    return pixel, scene[pixel]


def estimate(pixel: np.ndarray, values: np.ndarray, pixels: int, rate: float, kind: DriftKind) -> IntensityDrift | None:
    """Drift of samples in memory."""
    return estimate_intensity_drift(
        lambda first, stop: (pixel[first:stop], values[first:stop]), pixel.size, pixels, rate, kind
    )


def flicker(samples: int, knee: float, rng: np.random.Generator) -> np.ndarray:
    """Noise of the density of white noise of sd 1 times knee/f."""
    frequency = np.fft.rfftfreq(2 * samples, 1 / RATE)
    factor = np.zeros_like(frequency)
    factor[1:] = np.sqrt(knee / frequency[1:])
    return np.fft.irfft(np.fft.rfft(rng.standard_normal(2 * samples)) * factor)[:samples]


def block_means(values: np.ndarray, block: int) -> np.ndarray:
    whole = values.size // block * block
    return values[:whole].reshape(-1, block).mean(axis=1)


def mean_error(pixel: np.ndarray, values: np.ndarray, clean: np.ndarray) -> float:
    """Root-mean-square error of the mean picture, without its mean."""
    counts = np.bincount(pixel)
    error = np.bincount(pixel, values - clean)[counts > 0] / counts[counts > 0]
    return float(np.std(error))


def test_flicker_noise_at_ten_times_the_slow_axis_costs_at_most_5_percent() -> None:
    """In a scan as long and as fine as the demo's."""
    pixel, clean = crossing_scan(0.06, 400)
    rng = np.random.default_rng(1)
    white = clean + NOISE_SD * rng.standard_normal(clean.size)
    drift = NOISE_SD * flicker(clean.size, 41e3, rng)
    found = estimate(pixel, white + drift, 400**2, RATE, "offset")
    assert found is not None
    before, after, best = (mean_error(pixel, v, clean) for v in (white + drift, found.correct(white + drift), white))
    assert after <= 1.05 * best < before
    error = found.values[: clean.size // found.block] - block_means(drift - drift.mean(), found.block)
    assert 0.88 <= np.mean(np.abs(error - error.mean()) < 1.96 * found.sd) <= 0.99


@pytest.mark.parametrize("kind", ["offset", "gain"])
def test_noise_contains_the_error_of_the_drift(kind: DriftKind) -> None:
    """A drift of flicker noise above the noise of the samples, from few crossings.

    By the scatter of the samples alone, the variance of a pixel is too small by a factor of 2.0 and 1.3.
    """
    pixel, clean = crossing_scan(0.004)
    rng = np.random.default_rng(7)
    drift = NOISE_SD * flicker(clean.size, 4e5, rng)
    noise = NOISE_SD * rng.standard_normal(clean.size)
    values = (clean + drift if kind == "offset" else clean * np.exp(drift)) + noise
    found = estimate(pixel, values, PIXELS**2, RATE, kind)
    assert found is not None
    truth = block_means(drift - drift.mean() if kind == "offset" else np.exp(drift) / np.exp(drift).mean(), found.block)
    error = found.values[: truth.size] - truth
    assert 0.5 * np.std(error) < found.sd < 1.3 * np.std(error)
    corrected = found.correct(values)
    scatter = measure_sample_noise(pixel, corrected)
    assert scatter is not None
    counts = np.bincount(pixel)
    visited = counts > 0
    mean = np.bincount(pixel, corrected)[visited] / counts[visited]
    scene = np.bincount(pixel, clean)[visited] / counts[visited]
    scene *= np.exp(drift).mean() if kind == "gain" else 1.0
    predicted = np.mean(scatter.scaled(found.noise_factor).variance(scene) / counts[visited])
    assert np.var(mean - scene) / predicted == pytest.approx(1.0, abs=0.2)


def test_bleaching_is_a_gain() -> None:
    pixel, clean = crossing_scan(0.02)
    gain = np.exp(-np.linspace(0.0, 0.7, clean.size))
    noise = NOISE_SD * np.random.default_rng(2).standard_normal(clean.size)
    found = estimate(pixel, clean * gain + noise, PIXELS**2, RATE, "gain")
    assert found is not None
    corrected, best = found.correct(clean * gain + noise) / gain.mean(), clean + noise / gain
    assert mean_error(pixel, corrected, clean) <= 1.02 * mean_error(pixel, best, clean)


def test_a_gain_that_bleaches_to_a_tenth_is_positive_and_right() -> None:
    """With photon noise; a gain in the sense of 1 plus a Gaussian drift passes through zero there."""
    pixel, clean = crossing_scan(0.06)
    time = np.arange(clean.size) / RATE
    gain = np.exp(-time / 0.026)
    counts = np.random.default_rng(2).poisson(5.0 * clean * gain).astype(float)
    found = estimate(pixel, counts, PIXELS**2, RATE, "gain")
    assert found is not None
    assert found.correct(counts).min() >= 0.0
    expected = block_means(gain / gain.mean(), found.block)
    for part in np.array_split(np.arange(expected.size), 8):
        measured = (1.0 + found.values[part]).mean()
        assert measured == pytest.approx(expected[part].mean(), rel=0.03)


@pytest.mark.parametrize("noise_sd", [0.02, NOISE_SD])
def test_the_error_of_a_slow_gain_is_as_stated(noise_sd: float) -> None:
    """The pattern of the crossings modulates the gain, which does not count as noise."""
    pixel, clean = crossing_scan(0.02)
    gain = np.linspace(1.0, 0.6, clean.size)
    for seed in range(3):
        noise = noise_sd * np.random.default_rng(seed).standard_normal(clean.size)
        found = estimate(pixel, clean * gain + noise, PIXELS**2, RATE, "gain")
        assert found is not None
        error = found.values[: clean.size // found.block] - block_means(gain / gain.mean() - 1.0, found.block)
        assert 0.6 < np.std(error) / found.sd < 1.5


@pytest.mark.parametrize("samples", [1000, 4000, 8000])
def test_the_standard_deviation_contains_the_detail_of_the_scene_within_pixels(samples: int) -> None:
    """A steady detector and pixels of 1/40 and 1/20 of the field: all of the drift is error."""
    time = np.arange(samples) / 1e6
    x, y = np.sin(2 * np.pi * 2510.0 * time + 0.3), np.sin(2 * np.pi * 1130.0 * time + 1.1)
    pixel = (((y + 1) / 2 * 20).astype(int) * 40 + ((x + 1) / 2 * 40).astype(int)).astype(np.int32)
    spot = 50.0 * np.exp(-((x - 0.3) ** 2 + (y + 0.4) ** 2) / 0.02)
    clean = 100.0 + 60.0 * np.sin(9 * x + 2) * np.cos(6 * y + 1) + spot
    for seed in range(3):
        values = clean + 5.0 * np.random.default_rng(seed).standard_normal(samples)
        found = estimate(pixel, values, 800, 1e6, "gain")
        assert found is not None
        assert np.std(found.values) < 2.5 * found.sd  # detail that neighbouring pixels share is not contained


def test_a_steady_detector_stays_as_it_is() -> None:
    pixel, clean = crossing_scan(0.02)
    values = clean + NOISE_SD * np.random.default_rng(3).standard_normal(clean.size)
    found = estimate(pixel, values, PIXELS**2, RATE, "offset")
    assert found is not None
    assert mean_error(pixel, found.correct(values), clean) <= 1.002 * mean_error(pixel, values, clean)


def test_windows_join(monkeypatch: pytest.MonkeyPatch) -> None:
    """A recording solved in parts has one offset, because later parts use the scene of the earlier ones."""
    pixel, clean = crossing_scan(0.03)
    drift = np.linspace(0.0, 0.5, clean.size)
    values = clean + drift + NOISE_SD * np.random.default_rng(4).standard_normal(clean.size)
    monkeypatch.setattr("recon.imaging.intensity_drift.WINDOW_SAMPLES", clean.size // 3)
    found = estimate(pixel, values, PIXELS**2, RATE, "offset")
    assert found is not None
    np.testing.assert_allclose(
        found.values[: clean.size // found.block], block_means(drift - drift.mean(), found.block), atol=0.05
    )


def test_samples_outside_and_without_a_value_are_left_out() -> None:
    pixel, clean = crossing_scan(0.02)
    rng = np.random.default_rng(5)
    values = clean + np.linspace(0.0, 0.5, clean.size) + NOISE_SD * rng.standard_normal(clean.size)
    values[1000:2000] = np.nan
    pixel[5000:6000] = -1
    found = estimate(pixel, values, PIXELS**2, RATE, "offset")
    assert found is not None
    assert np.isfinite(found.values).all()
    assert np.ptp(found.values) == pytest.approx(0.5, abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["offset", "gain"])
def test_the_command_removes_a_drift_and_states_it(kind: str, tmp_path: Path) -> None:
    recording = imaging()[0]
    intensity = recording["intensity"]
    recording.with_channel(replace(intensity, raw=intensity.read() * np.linspace(1.0, 0.6, intensity.size))).write(
        tmp_path / "scan.h5"
    )
    out = tmp_path / "out"
    assert main(["reconstruct", str(tmp_path / "scan.h5"), "-o", str(out), "--intensity-drift", kind]) == 0
    summary = json.loads((out / "summary.json").read_text())
    (drift,) = summary["intensity_drift"]
    assert drift["kind"] == kind
    assert drift["rms"] > 5 * drift["sd"] > 0
    assert any(f"{kind} drift" in note for note in summary["notes"])


def test_without_crossings_nothing_is_estimated() -> None:
    pixel = np.arange(PIXELS**2, dtype=np.int32)
    assert estimate(pixel, np.ones(pixel.size), PIXELS**2, RATE, "offset") is None


def test_memory_does_not_grow_with_the_recording(monkeypatch: pytest.MonkeyPatch) -> None:
    """Samples are read once, a window at a time."""
    pixel, clean = crossing_scan(0.02)
    values = clean + np.linspace(0.0, 0.5, clean.size) + NOISE_SD * np.random.default_rng(7).standard_normal(clean.size)
    parts = []

    def read(first: int, stop: int) -> tuple[np.ndarray, np.ndarray]:
        parts.append((first, stop))
        return pixel[first:stop], values[first:stop]

    monkeypatch.setattr("recon.imaging.intensity_drift.WINDOW_SAMPLES", 30_000)
    assert estimate_intensity_drift(read, pixel.size, PIXELS**2, RATE, "offset") is not None
    assert parts == [(first, min(first + 30_000, 100_000)) for first in range(0, 100_000, 30_000)]


@pytest.mark.parametrize("kind", ["offset", "gain"])
@pytest.mark.parametrize("bright", [0, 1])
def test_samples_without_noise_determine_no_drift(kind: DriftKind, bright: int) -> None:
    pixel, clean = crossing_scan(0.02)
    values = np.zeros(clean.size)
    values[:bright] = 1.0
    found = estimate(pixel, values, PIXELS**2, RATE, kind)
    assert found is None or np.abs(found.values).max() <= 3 * found.sd


def test_the_spectrum_of_flicker_noise_is_measured() -> None:
    """Within a third: the mean picture takes some of the drift below the scan's frequencies."""
    pixel, clean = crossing_scan(0.03)
    rng = np.random.default_rng(6)
    values = clean + NOISE_SD * (rng.standard_normal(clean.size) + flicker(clean.size, 41e3, rng))
    nothing = SceneSums(np.zeros(PIXELS**2 + 1), np.zeros(PIXELS**2 + 1))
    model = fit_drift_model(pixel, values, nothing, RATE / 15, 15, "offset")
    assert model is not None
    assert model.white == pytest.approx(NOISE_SD**2 / RATE, rel=0.1)
    assert model.flicker == pytest.approx(41e3 * NOISE_SD**2 / RATE, rel=0.33)
