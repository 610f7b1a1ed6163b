"""Threshold crossings: accuracy compared with Canny's formula, and detection in blocks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.papers.threshold import (
    NOISE,
    RATE,
    canny_variance,
    detector,
    lilliefors,
    pooled_errors,
    sensing_axis,
    signal,
    timing_errors,
)
from estimation.filters.threshold import CrossingDetector, calibrate_crossings, find_crossings, find_crossings_in_blocks
from scanner.laws import capacitance_slope, transimpedance_voltage


def noisy(seed: int, cycles: int = 30) -> np.ndarray:
    rng = np.random.default_rng(seed)
    clean, _ = signal(RATE, cycles, rng)
    return clean + NOISE * rng.standard_normal(clean.size)


def test_filtered_ramp_is_its_slope():
    ramp = CrossingDetector(5.0, 60, 20, 0.0)
    assert ramp.kernel @ (0.3 * np.arange(ramp.kernel.size)) == pytest.approx(0.3)
    assert ramp.kernel.sum() == pytest.approx(0.0, abs=1e-12)


def test_every_crossing_is_detected_once_at_its_time():
    rng = np.random.default_rng(1)
    clean, true = signal(RATE, 20, rng)
    found = find_crossings(clean, replace(detector(), noise_sd=1e-6))
    inside = true[(true > detector().latency) & (true < clean.size - detector().latency)]
    assert found.size == inside.size
    assert np.abs(found - inside).max() < 0.05


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10**6), blocks=st.integers(2, 300))
def test_detection_in_blocks_gives_the_same_crossings(seed, blocks):
    values = noisy(seed)
    of = detector(40.0)
    detected = list(find_crossings_in_blocks(np.array_split(values, blocks), of))
    found = np.concatenate([positions for positions, _ in detected])
    np.testing.assert_allclose(found, find_crossings(values, of), atol=1e-6)
    for positions, arrived in detected:
        assert (positions + of.latency <= arrived + 1).all()


def test_no_crossing_is_reported_before_its_latency():
    values, of = noisy(3), detector(40.0)
    whole = find_crossings(values, of)
    for stop in (7000, 9001, 12345):
        early = find_crossings(values[:stop], of)
        np.testing.assert_allclose(early, whole[whole + of.latency < stop - 1][: early.size], atol=1e-6)
        assert early.size >= (whole + of.latency + 1 < stop).sum()


@pytest.mark.parametrize("sigma", [15.0, 40.0])
def test_timing_variance_agrees_with_cannys_formula(sigma):
    of, rng = detector(sigma), np.random.default_rng(5)
    found = timing_errors(of, RATE, NOISE, rng, 250)
    assert np.var(found) == pytest.approx(canny_variance(of, RATE, NOISE), rel=0.3)


def test_timing_variance_decreases_with_the_slope():
    variances = [canny_variance(detector(), RATE, NOISE, slope) for slope in (0.2, 0.5, 1.0, 2.0, 5.0)]
    assert (np.diff(variances) < 0).all()


def test_rounding_to_samples_has_an_optimal_rate_and_interpolation_has_none():
    """Fig 5a: rounding increases the variance at low rates, a Gaussian of 15 samples at high ones."""
    rng, low = np.random.default_rng(7), 0.1 * NOISE
    spread = {
        rate: np.var(pooled_errors(detector(15.0, rate, low), rate, low, rng, 12, whole_samples=True))
        for rate in (1e5, 1e6, 5e6)
    }
    assert spread[1e6] < 0.2 * min(spread[1e5], spread[5e6])
    scaled = [np.var(pooled_errors(detector(15.0 * r / RATE, r, low), r, low, rng, 12)) for r in (1e5, 1e6)]
    assert scaled[1] < 0.5 * scaled[0]


def test_calibration_of_crossings_is_valid_for_a_nonzero_theta_th():
    """The angle of steepest slope differs from theta_th; the calibration states by how much."""
    axis = sensing_axis()
    comb, readout = axis.require_capacitance(), axis.require_readout()
    w, A = 2 * np.pi * axis.resonance, 0.06
    time = np.arange(20000) / RATE
    theta, omega = A * np.sin(w * time), A * w * np.cos(w * time)
    values = transimpedance_voltage(
        capacitance_slope(theta, comb.C0, comb.theta0, comb.theta_th), omega, readout.R_s, readout.V_bias
    )
    of = CrossingDetector(60.0, 500, 160, 1e-6)
    law = calibrate_crossings(axis, of, axis.resonance, 1 / RATE)
    expected = np.interp(A * w, law.rates, law.angles)
    measured = np.interp(find_crossings(values, of), np.arange(time.size), theta)
    assert abs(expected - comb.theta_th) > 5e-4
    np.testing.assert_allclose(measured, expected, atol=5e-5)


def test_lilliefors_distinguishes_normal_from_uniform():
    rng = np.random.default_rng(8)
    assert lilliefors(rng.standard_normal(200), rng) > 0.02
    assert lilliefors(rng.uniform(size=200), rng) < 0.01
