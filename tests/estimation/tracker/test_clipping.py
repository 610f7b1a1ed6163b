"""Clipped samples: their likelihood, and tracks of clipped signals."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm

from benchmarks.clipped import SAMPLE_RATE_HZ, clip_signal, simulate_transimpedance, track_clipped_segment, with_signal
from estimation.tracker import track
from estimation.tracker.clipping import expand_samples
from estimation.tracker.cramer_rao import censored_information_fraction

RAILS = np.array([-0.4, 0.7])


def log_likelihood(values: np.ndarray, h: np.ndarray, sd: float) -> np.ndarray:
    inside = norm.logpdf((values - h) / sd)
    return np.select(
        [values > RAILS[1], values < RAILS[0]],
        [norm.logsf((RAILS[1] - h) / sd), norm.logcdf((RAILS[0] - h) / sd)],
        inside,
    )


def test_expansion_has_the_derivatives_of_the_log_likelihood() -> None:
    rng, sd, step = np.random.default_rng(0), 0.3, 1e-3
    values, h = rng.normal(size=400), rng.normal(size=400)
    below, here, above = (log_likelihood(values, h + d, sd) for d in (-step, 0.0, step))
    expansion = expand_samples(values, RAILS, h, sd)
    assert np.allclose(expansion.gradient / sd**2, (above - below) / (2 * step), rtol=1e-3, atol=1e-3)
    assert np.allclose(expansion.weight, -(above - 2 * here + below) / step**2 * sd**2, atol=1e-3)


@pytest.mark.parametrize("rails", [(-0.4, 0.7), (-np.inf, 0.2), (0.1, 0.1)])
def test_mean_weight_is_the_remaining_information(rails: tuple[float, float]) -> None:
    sd, n = 0.3, 200_000
    for h in (-0.6, 0.0, 0.5, 0.9):
        values = h + np.random.default_rng(1).normal(0.0, sd, n)
        expansion = expand_samples(values, np.array(rails), np.full(n, h), sd)
        (fraction,) = censored_information_fraction(np.array([h]), rails, sd)
        assert expansion.weight.mean() == pytest.approx(fraction, abs=5e-3)
        assert np.mean(expansion.gradient**2) / sd**2 == pytest.approx(fraction, abs=1e-2)


@pytest.mark.slow
def test_clipped_segment_is_unbiased_and_its_intervals_cover_the_truth() -> None:
    results = track_clipped_segment(5, 2)
    assert results["clipped"]["rmse_deg"] < 0.025  # 0.14 with the samples between the rails alone
    assert results["clipped"]["held"] > 0.85
    assert results["whole scan"]["held"] > 0.9


@pytest.mark.parametrize(("rail", "most"), [(0.1, 0.032), (0.0, 0.07)])
def test_crossings_of_the_rails_determine_the_phase(rail: float, most: float) -> None:
    """The bounds are 0.028 and 0.057 degrees. Samples between the rails alone give 0.035; a comparator has none."""
    device, quiet = simulate_transimpedance()
    signal = quiet["sense_x"].read()
    exact = track(quiet, device).axes["x"].phase
    errors = []
    for seed in range(4):
        noisy = signal + np.random.default_rng(seed).normal(0.0, 0.0435, signal.size)
        axis = track(with_signal(quiet, device, "sense_x", clip_signal(noisy, rail * np.abs(signal).max())), device)
        errors.append((axis.axes["x"].phase - exact + np.pi / 2) % np.pi - np.pi / 2)
    assert quiet["sense_x"].sample_rate == SAMPLE_RATE_HZ
    assert np.rad2deg(np.sqrt(np.mean(np.square(errors)))) < most
