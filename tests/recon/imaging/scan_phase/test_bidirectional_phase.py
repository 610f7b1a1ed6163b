"""Phase errors from forward and backward half-periods are unbiased and have correct standard errors."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.ndimage import map_coordinates
from skimage.data import immunohistochemistry

from recon.imaging.picture import Grid
from recon.imaging.scan_phase.bidirectional_phase import measure_phase_errors, quadrature
from recon.imaging.scan_phase.bidirectional_search import RegistrationSamples, search_phase_errors
from scanner.errors import BadInput

GRID = Grid(400, 400, 0.18, 0.16)
SAMPLE_RATE_HZ = 5e6
A_X, A_Y = 0.18, 0.16


@cache
def tissue():
    return immunohistochemistry() @ [0.2125, 0.7154, 0.0721] / 255


def scan(error_x, error_y, n=300_000, scene=None, photons=100.0, seed=0, a_x=A_X, a_y=A_Y, f_y=3_270, f_x=13_840):
    """Assumed angles, and intensities at the true angles, which lead by the given phase errors [rad]."""
    rng = np.random.default_rng(seed)
    scene = tissue() if scene is None else scene
    t = np.arange(n) / SAMPLE_RATE_HZ
    start_x, start_y = rng.uniform(0, 2 * np.pi, 2)
    alpha_x, alpha_y = 2 * np.pi * f_x * t + start_x, 2 * np.pi * f_y * t + start_y
    true = [a_y * np.sin(alpha_y + error_y) / GRID.half_angle_y, a_x * np.sin(alpha_x + error_x) / GRID.half_angle_x]
    places = [(s + 1) / 2 * size - 0.5 for s, size in zip(true, scene.shape, strict=True)]
    intensity = map_coordinates(scene, places, order=1, mode="nearest")
    return a_x * np.sin(alpha_x), a_y * np.sin(alpha_y), rng.poisson(intensity * photons) / photons


def registered(theta_x, theta_y, intensity, slices=1, a_x=A_X, a_y=A_Y):
    """Values and standard errors [deg], shape (slices, 2)."""
    found = measure_phase_errors(theta_x, theta_y, intensity, SAMPLE_RATE_HZ, GRID, a_x, a_y, slices)
    return tuple(np.degrees([[getattr(axis, part) for axis in (e.x, e.y)] for e in found]) for part in ("value", "sd"))


@pytest.mark.slow
@pytest.mark.parametrize("true", [(0.0, 0.0), (0.3, -0.1), (-3.0, 2.0), (1.0, 3.0), (9.0, -9.0)])
def test_phase_errors_are_measured_to_a_hundredth_of_a_pixel(true):
    (value,), (sd,) = registered(*scan(*np.radians(true)))
    assert_allclose(value, true, atol=0.012)  # four standard errors; positive if the true angle leads
    assert (np.radians(sd) * 200 < 0.015).all()


@pytest.mark.slow
def test_standard_errors_equal_the_scatter_of_repeated_scans():
    pulls = []
    for seed in range(12):
        true = np.random.default_rng(seed).uniform(-3, 3, 2)
        value, sd = registered(*scan(*np.radians(true), n=100_000, photons=30, seed=seed))
        pulls.append((value[0] - true) / sd[0])
    assert 0.5 < np.sqrt(np.mean(np.square(pulls))) < 1.4
    assert np.abs(pulls).max() < 4


def test_standard_errors_hold_where_every_line_is_sampled_at_the_same_places():
    """100 samples in a period of x: neighbours are 12 pixels apart in the middle of the field."""
    pulls = []
    for seed in range(8):
        angles_and_intensity = scan(0.0, 0.0, n=60_000, f_x=50_000, f_y=2_750, photons=1000.0, seed=seed)
        (found,) = measure_phase_errors(*angles_and_intensity, SAMPLE_RATE_HZ, GRID, A_X, A_Y)
        error = found.with_common_shift()
        pulls += [axis.value / axis.sd for axis in (error.x, error.y)]
    assert 0.5 < np.sqrt(np.nanmean(np.square(pulls))) < 1.4
    assert np.nanmax(np.abs(pulls)) < 3.0


@pytest.mark.parametrize("f_y", [13_800, 6_940, 4_620])
def test_a_figure_whose_directions_share_few_places_determines_no_phase(f_y):
    """Nearly 1 : 1, 2 : 1 and 3 : 1: the figure hardly changes within a slice of 2 ms."""
    for seed in range(3):
        value, sd = registered(*scan(0.0, 0.0, n=90_000, seed=seed, f_y=f_y), slices=9)
        assert not (np.abs(value) > 3 * sd).any()
        assert np.isnan(value).mean() > 0.8


def test_slices_follow_a_drifting_phase_error():
    t = np.linspace(0, 1, 300_000)
    drift = np.array([3 * np.sin(3 * t), 2 - 4 * t])
    value, sd = registered(*scan(*np.radians(drift)), slices=10)
    true = drift.reshape(2, 10, -1).mean(2).T
    assert_allclose(value, true, atol=0.15)
    assert_allclose(value.mean(0), true.mean(0), atol=0.05)
    assert (sd < 0.1).all()


def test_slices_have_the_times_of_their_centres():
    times = [e.time for e in measure_phase_errors(*scan(0, 0, n=100_000), SAMPLE_RATE_HZ, GRID, A_X, A_Y, slices=4)]
    assert_allclose(times, [0.0025, 0.0075, 0.0125, 0.0175])


def test_few_photons_give_large_standard_errors_and_no_bias():
    (value,), (sd,) = registered(*scan(*np.radians([2.0, -1.0]), photons=1.0))
    assert (np.abs(value - [2, -1]) < 3 * sd).all()
    assert ((sd > 0.02) & (sd < 0.2)).all()


@pytest.mark.slow
def test_in_strong_noise_an_error_is_either_correct_or_undetermined():
    value, sd = registered(*scan(*np.radians([2.0, 1.5]), photons=1.0, seed=4), slices=6)
    determined = np.isfinite(sd)
    assert (np.abs(value - [2.0, 1.5])[determined] < 4 * sd[determined]).all()
    assert 0 < determined.sum() < determined.size


@pytest.mark.slow
def test_short_slices_are_compared_at_equal_positions():
    """Ten milliseconds cover a quarter of the field, so forward and backward samples lie at different positions."""
    errors = []
    for seed in range(3):
        value, _ = registered(*scan(*np.radians([1.0, -1.0]), photons=1000, seed=seed), slices=6)
        errors.append(value - [1.0, -1.0])
    assert np.sqrt(np.mean(np.square(errors), axis=(0, 1))).max() < 0.007  # 0.009 if compared at unequal positions


def test_an_amplitude_error_does_not_bias_the_phase():
    x, y, intensity = scan(*np.radians([1.0, -2.0]))
    (value,), (sd,) = registered(1.02 * x, 0.985 * y, intensity, a_x=1.02 * A_X, a_y=0.985 * A_Y)
    assert_allclose(value, [1, -2], atol=0.02)
    assert (sd < 0.01).all()


def test_phase_errors_of_a_spiral_with_growing_amplitude_are_measured():
    growth = np.linspace(0.2, 1, 300_000)
    x, y, intensity = scan(*np.radians([0.4, -0.5]), a_x=A_X * growth, a_y=A_Y * growth)
    (value,), _ = registered(x, y, intensity, a_x=A_X * growth, a_y=A_Y * growth)
    assert_allclose(value, [0.4, -0.5], atol=0.02)


def test_a_sample_without_features_determines_no_phase():
    value, sd = registered(*scan(0.01, 0.01, n=100_000, scene=np.full((8, 8), 0.5)), slices=2)
    assert np.isnan(value).all()
    assert (sd == np.inf).all()


@pytest.mark.slow
def test_bars_determine_only_the_phase_across_them():
    bars = np.tile(np.where(np.arange(512) % 20 < 10, 0.9, 0.1), (512, 1))
    for seed in range(2):
        (value,), (sd,) = registered(*scan(*np.radians([1.0, 1.0]), scene=bars, seed=seed))
        assert value[0] == pytest.approx(1, abs=0.01)
        assert np.isnan(value[1])
        assert sd[1] == np.inf


def test_a_too_short_scan_determines_no_phase():
    value, sd = registered(*scan(0, 0, n=200))
    assert np.isnan(value).all()
    assert (sd == np.inf).all()
    assert (
        len(measure_phase_errors(np.empty(0), np.empty(0), np.empty(0), SAMPLE_RATE_HZ, GRID, A_X, A_Y, slices=3)) == 3
    )


@pytest.mark.slow
def test_missing_samples_are_omitted_and_detectors_are_averaged():
    x, y, intensity = scan(*np.radians([1.0, -2.0]))
    x[1000:1500], intensity[::7] = np.nan, np.nan
    both = np.stack([1.5 * intensity, 0.5 * intensity], axis=1)
    value, _ = registered(x, y, intensity)
    assert_allclose(value, [[1, -2]], atol=0.02)
    assert_allclose(registered(x, y, both)[0], value, atol=1e-6)


@given(st.floats(0.05, 0.5), st.floats(1000, 30_000), st.floats(0, 6.28), st.floats(0, 0.005))
def test_quadrature_is_the_cosine_to_the_sine(amplitude, frequency, start, noise):
    alpha = 2 * np.pi * frequency * np.arange(20_000) / SAMPLE_RATE_HZ + start
    theta = amplitude * np.sin(alpha)
    cosine = quadrature(theta + amplitude * noise * np.random.default_rng(0).normal(size=theta.size), amplitude)
    wrong = np.abs(cosine / amplitude - np.cos(alpha)) > 0.25  # noise may change signs near turning points
    assert wrong[2000:-2000].mean() == 0  # the direction is unknown at both ends


def test_arrays_of_unequal_length_and_zero_slices_are_refused():
    with pytest.raises(BadInput, match="one angle of each axis"):
        measure_phase_errors(np.zeros(3), np.zeros(4), np.zeros(3), SAMPLE_RATE_HZ, GRID, A_X, A_Y)
    with pytest.raises(BadInput, match="0 slices"):
        measure_phase_errors(np.zeros(3), np.zeros(3), np.zeros(3), SAMPLE_RATE_HZ, GRID, A_X, A_Y, slices=0)


def test_input_arrays_are_not_modified():
    x, y, intensity = scan(0.01, 0.01, n=50_000)
    before = x.copy(), y.copy(), intensity.copy()
    measure_phase_errors(x, y, intensity, SAMPLE_RATE_HZ, GRID, A_X, A_Y)
    for array, copy in zip((x, y, intensity), before, strict=True):
        assert_array_equal(array, copy)


def test_an_axis_that_does_not_move_has_no_phase_error() -> None:
    y = np.linspace(-1.0, 1.0, 64)
    still = np.zeros_like(y)
    samples = RegistrationSamples(still, y, still, np.ones_like(y), np.cos(y), np.zeros(y.size, np.int64))
    assert np.isnan(search_phase_errors(samples)).all()


def test_a_slice_without_samples_leaves_the_others_determined():
    """A gap of the intensity or of the known angle that is longer than a slice."""
    theta_x, theta_y, intensity = scan(*np.radians((0.3, -0.1)))
    intensity[75_000:150_000] = np.nan
    value, sd = registered(theta_x, theta_y, intensity, slices=4)
    others = [0, 2, 3]
    assert np.isnan(value[1]).all()
    assert np.isinf(sd[1]).all()
    assert_allclose(value[others], np.tile([0.3, -0.1], (3, 1)), atol=0.04)
