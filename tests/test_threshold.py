"""Threshold crossings: placed as Canny's formula says, the same from a buffer as from the whole signal."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.papers.threshold import NOISE, RATE, canny, detector, errors, lilliefors, many, sensing_axis, signal
from estimation.threshold import Detector, buffered_crossings, crossing_law, crossings
from scanner.laws import capacitance_slope, transimpedance_voltage


def noisy(seed: int, cycles: int = 30) -> np.ndarray:
    rng = np.random.default_rng(seed)
    clean, _ = signal(RATE, cycles, rng)
    return clean + NOISE * rng.standard_normal(clean.size)


def test_filter_of_a_ramp_is_its_slope():
    ramp = Detector(5.0, 60, 20, 0.0)
    assert ramp.kernel @ (0.3 * np.arange(ramp.kernel.size)) == pytest.approx(0.3)
    assert ramp.kernel.sum() == pytest.approx(0.0, abs=1e-12)


def test_every_crossing_is_found_once_and_where_it_is():
    rng = np.random.default_rng(1)
    clean, true = signal(RATE, 20, rng)
    found = crossings(clean, replace(detector(), noise_sd=1e-6))
    inside = true[(true > detector().latency) & (true < clean.size - detector().latency)]
    assert found.size == inside.size
    assert np.abs(found - inside).max() < 0.05


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10**6), blocks=st.integers(2, 300))
def test_a_buffer_sees_the_same_crossings(seed, blocks):
    values = noisy(seed)
    of = detector(40.0)
    known = list(buffered_crossings(np.array_split(values, blocks), of))
    found = np.concatenate([positions for positions, _ in known])
    np.testing.assert_allclose(found, crossings(values, of), atol=1e-6)
    for positions, arrived in known:
        assert (positions + of.latency <= arrived + 1).all()


def test_no_crossing_is_told_before_its_latency():
    values, of = noisy(3), detector(40.0)
    whole = crossings(values, of)
    for stop in (7000, 9001, 12345):
        early = crossings(values[:stop], of)
        np.testing.assert_allclose(early, whole[whole + of.latency < stop - 1][: early.size], atol=1e-6)
        assert early.size >= (whole + of.latency + 1 < stop).sum()


@pytest.mark.parametrize("sigma", [15.0, 40.0])
def test_timing_scatters_as_cannys_formula_says(sigma):
    of, rng = detector(sigma), np.random.default_rng(5)
    found = errors(of, RATE, NOISE, rng, 250)
    assert np.var(found) == pytest.approx(canny(of, RATE, NOISE), rel=0.3)


def test_variance_falls_with_the_sensors_slope():
    variances = [canny(detector(), RATE, NOISE, slope) for slope in (0.2, 0.5, 1.0, 2.0, 5.0)]
    assert (np.diff(variances) < 0).all()


def test_whole_samples_have_a_best_rate_and_placing_between_samples_has_none():
    """Fig 5a: rounding hurts at low rates, a Gaussian that stays 15 samples at high ones."""
    rng, low = np.random.default_rng(7), 0.1 * NOISE
    spread = {
        rate: np.var(many(detector(15.0, rate, low), rate, low, rng, 12, whole_samples=True))
        for rate in (1e5, 1e6, 5e6)
    }
    assert spread[1e6] < 0.2 * min(spread[1e5], spread[5e6])
    scaled = [np.var(many(detector(15.0 * r / RATE, r, low), r, low, rng, 12)) for r in (1e5, 1e6)]
    assert scaled[1] < 0.5 * scaled[0]


def test_law_of_a_crossing_holds_where_theta_th_is_not_zero():
    """The steepest place is not quite theta_th, by an amount the law tells."""
    axis = sensing_axis()
    comb, readout = axis.require_capacitance(), axis.require_readout()
    w, A = 2 * np.pi * axis.resonance, 0.06
    time = np.arange(20000) / RATE
    theta, omega = A * np.sin(w * time), A * w * np.cos(w * time)
    values = transimpedance_voltage(
        capacitance_slope(theta, comb.C0, comb.theta0, comb.theta_th), omega, readout.R_s, readout.V_bias
    )
    of = Detector(60.0, 500, 160, 1e-6)
    law = crossing_law(axis, of, axis.resonance, 1 / RATE)
    told = np.interp(A * w, law.rates, law.angles)
    seen = np.interp(crossings(values, of), np.arange(time.size), theta)
    assert abs(told - comb.theta_th) > 5e-4
    np.testing.assert_allclose(seen, told, atol=5e-5)


def test_lilliefors_tells_normal_from_uniform():
    rng = np.random.default_rng(8)
    assert lilliefors(rng.standard_normal(200), rng) > 0.02
    assert lilliefors(rng.uniform(size=200), rng) < 0.01
