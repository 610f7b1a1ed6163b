"""Samples beyond a rail: their likelihood, and tracks of signals that leave their rails."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm

from benchmarks.clipped import RATE, clipped, in_a_stretch, transimpedance_world, with_signal
from estimation.tracker import track
from estimation.tracker.bound import share_kept
from estimation.tracker.censored import expanded

RAILS = np.array([-0.4, 0.7])


def log_likelihood(values: np.ndarray, h: np.ndarray, sd: float) -> np.ndarray:
    inside = norm.logpdf((values - h) / sd)
    return np.select(
        [values > RAILS[1], values < RAILS[0]],
        [norm.logsf((RAILS[1] - h) / sd), norm.logcdf((RAILS[0] - h) / sd)],
        inside,
    )


def test_samples_are_expanded_as_their_likelihood_bends() -> None:
    rng, sd, step = np.random.default_rng(0), 0.3, 1e-3
    values, h = rng.normal(size=400), rng.normal(size=400)
    below, here, above = (log_likelihood(values, h + d, sd) for d in (-step, 0.0, step))
    own = expanded(values, RAILS, h, sd)
    assert np.allclose(own.pull / sd**2, (above - below) / (2 * step), rtol=1e-3, atol=1e-3)
    assert np.allclose(own.weight, -(above - 2 * here + below) / step**2 * sd**2, atol=1e-3)


@pytest.mark.parametrize("rails", [(-0.4, 0.7), (-np.inf, 0.2), (0.1, 0.1)])
def test_weights_are_on_average_the_information_that_is_kept(rails: tuple[float, float]) -> None:
    sd, n = 0.3, 200_000
    for h in (-0.6, 0.0, 0.5, 0.9):
        values = h + np.random.default_rng(1).normal(0.0, sd, n)
        own = expanded(values, np.array(rails), np.full(n, h), sd)
        (kept,) = share_kept(np.array([h]), rails, sd)
        assert own.weight.mean() == pytest.approx(kept, abs=5e-3)
        assert np.mean(own.pull**2) / sd**2 == pytest.approx(kept, abs=1e-2)


def test_a_clipped_stretch_is_unbiased_and_its_intervals_hold() -> None:
    found = in_a_stretch(5, 2)
    assert found["clipped"]["rmse_deg"] < 0.025  # 0.14 with the samples between the rails alone
    assert found["clipped"]["held"] > 0.85
    assert found["whole scan"]["held"] > 0.9


@pytest.mark.parametrize(("rail", "most"), [(0.1, 0.032), (0.0, 0.07)])
def test_the_times_at_which_a_signal_meets_its_rails_tell_the_phase(rail: float, most: float) -> None:
    """0.028 and 0.057 degrees are the bounds, 0.035 that of the samples between the rails; a comparator has none."""
    device, quiet = transimpedance_world()
    signal = quiet["sense_x"].read()
    exact = track(quiet, device).axes["x"].phase
    errors = []
    for seed in range(4):
        noisy = signal + np.random.default_rng(seed).normal(0.0, 0.0435, signal.size)
        axis = track(with_signal(quiet, device, "sense_x", clipped(noisy, rail * np.abs(signal).max())), device)
        errors.append((axis.axes["x"].phase - exact + np.pi / 2) % np.pi - np.pi / 2)
    assert quiet["sense_x"].sample_rate == RATE
    assert np.rad2deg(np.sqrt(np.mean(np.square(errors)))) < most
