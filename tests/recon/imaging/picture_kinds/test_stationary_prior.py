"""Pictures under a stationary prior whose covariance is measured from the samples."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from recon.imaging.picture_kinds.held_out import SplitSums, pixel_means, representative_weights
from recon.imaging.picture_kinds.kernel_picture import find_reached
from recon.imaging.picture_kinds.posterior_picture import posterior_picture
from recon.imaging.picture_kinds.scene_covariance import measure_covariance
from recon.imaging.picture_kinds.stationary_prior import fit_spectrum, measure_centre_detail, stationary_mean
from recon.imaging.pixel_noise import SampleNoise
from recon.imaging.smoothing import kernel_mean, smooth
from scanner.arrays import Array

SIZE = 128
NOISE = 0.5


def texture(down: float, across: float, seed: int = 0) -> Array:
    """A stationary random scene of unit variance with correlation lengths of sqrt(2) times the widths."""
    scene = gaussian_filter(np.random.default_rng(seed).normal(size=(SIZE, SIZE)), (down, across), mode="reflect")
    return np.asarray(scene / scene.std())


def sample(scene: Array, visited: Array, sd: float = NOISE, seed: int = 1) -> SplitSums:
    """One sample in each visited pixel, a tenth of them held out in segments of eight along the rows."""
    noisy = scene + sd * np.random.default_rng(seed).normal(size=scene.shape)
    counts = visited.astype(float)
    held = counts * (np.add.outer(5 * np.arange(SIZE), np.arange(SIZE) // 8) % 10 == 0)
    return SplitSums(noisy * counts, counts, noisy * held, held)


def lines(every: int) -> Array:
    """Rows that a raster visits, shape (SIZE, SIZE)."""
    return np.repeat((np.arange(SIZE) % every == 0)[:, None], SIZE, axis=1)


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def test_the_measured_covariance_is_that_of_the_scene_without_its_noise() -> None:
    scattered = np.random.default_rng(2).random((SIZE, SIZE)) < 0.3
    samples = sample(texture(2.0, 4.0), scattered, sd=1.0)
    spectrum = fit_spectrum(measure_covariance(samples.sums, samples.counts))
    assert spectrum.mean() == pytest.approx(1.0, rel=0.15)  # the mean over the modes is the variance
    wave_number = np.pi * np.arange(SIZE) / SIZE
    across, down = ((spectrum.sum(axis) @ wave_number**2 / spectrum.sum()) ** -0.5 for axis in (0, 1))
    assert across == pytest.approx(np.sqrt(2) * 4.0, rel=0.25)  # the root of variance over mean squared slope
    assert down == pytest.approx(np.sqrt(2) * 2.0, rel=0.25)


def test_a_smooth_scene_between_rows_errs_less_than_linear_interpolation() -> None:
    scene = texture(1.5, 3.0)
    samples = sample(scene, lines(2), sd=0.2)
    linear = 0.5 * (np.roll(samples.sums, 1, 0) + np.roll(samples.sums, -1, 0))
    estimate = posterior_picture(samples, SampleNoise(0.2**2, 0.0, 0.0)).image
    left_out = slice(1, SIZE - 1, 2)
    assert rms((estimate - scene)[left_out]) < 0.7 * rms((linear - scene)[left_out])


def test_a_texture_errs_less_than_with_any_kernel() -> None:
    scene = texture(1.0, 2.5)
    samples = sample(scene, np.random.default_rng(3).random((SIZE, SIZE)) < 0.25)
    kernels = [rms(kernel_mean(samples.sums, samples.counts, width) - scene) for width in np.geomspace(0.4, 16.0, 30)]
    estimate = posterior_picture(samples, SampleNoise(NOISE**2, 0.0, 0.0))
    assert rms(estimate.image - scene) < 0.92 * min(kernels)
    assert np.mean(np.abs(estimate.image - scene) < 1.96 * estimate.sd) > 0.93


def test_a_solution_begun_with_a_similar_one_is_the_same() -> None:
    samples = sample(texture(1.0, 2.5), lines(3))
    spectrum = fit_spectrum(measure_covariance(samples.sums, samples.counts))
    arguments = pixel_means(samples.sums, samples.counts), samples.counts / NOISE**2, spectrum, 0.0
    solution = stationary_mean(*arguments)
    again = stationary_mean(*arguments, start=solution + 0.1 * texture(4.0, 4.0, seed=5))
    assert rms(again - solution) < 0.06 * rms(solution)


def test_a_scene_without_structure_has_its_mean() -> None:
    samples = sample(np.full((SIZE, SIZE), 7.0), lines(2), sd=0.0)
    spectrum = fit_spectrum(measure_covariance(samples.sums, samples.counts))
    means = pixel_means(samples.sums, samples.counts)
    assert stationary_mean(means, samples.counts, spectrum, 7.0) == pytest.approx(np.full((SIZE, SIZE), 7.0))


@pytest.mark.parametrize(("visited", "scene"), [(0.01, "texture"), (0.3, "noise"), (1.0, "noise")])
def test_samples_without_a_covariance_have_a_picture(visited: float, scene: str) -> None:
    """Too few pairs of pixels at any lag, or pixels that do not correlate at all."""
    rng = np.random.default_rng(8)
    values = texture(2.0, 2.0)[:48, :31] if scene == "texture" else rng.normal(size=(48, 31))
    counts = (rng.random(values.shape) < visited).astype(float)
    held = counts * (rng.random(values.shape) < 0.2)
    samples = SplitSums(1e-6 * values * counts, counts, 1e-6 * values * held, held)
    estimate = posterior_picture(samples, SampleNoise(0.0, 0.0, 0.0))
    reached = np.isfinite(estimate.image)
    assert reached.any()
    assert np.isfinite(estimate.sd[reached]).all()


def test_only_detail_of_the_size_of_a_pixel_is_larger_at_the_centres() -> None:
    fine, coarse = (
        measure_centre_detail(
            fit_spectrum(measure_covariance(texture(width, width), np.ones((SIZE, SIZE)))), 1e-6
        ).variance
        for width in (0.7, 8.0)
    )
    assert coarse == pytest.approx(1.0, abs=0.02)
    assert 1.3 < fine < 4.0


def test_held_out_pixels_count_as_pixels_at_their_distance_do() -> None:
    """With every fourth row visited, the pixels between are 1 or 2 pixels from a sample, held-out ones up to 4."""
    samples = sample(texture(2.0, 2.0), lines(4))
    weight = representative_weights(samples)
    held = samples.held_counts > 0
    assert not weight[~held].any()
    assert weight[held].mean() == pytest.approx(1.0)
    near = held & (np.roll(samples.kept_counts, 1, 1) + np.roll(samples.kept_counts, -1, 1) > 0)
    assert near.sum() > 20
    assert weight[near].mean() > 2.0 * weight[held & ~near].mean()


def test_a_wide_gaussian_is_as_scipy_computes_it() -> None:
    image = texture(1.0, 1.0)[:, :100]
    for width in (4.0, 7.0, 16.0):
        expected = gaussian_filter(image, width, mode="reflect", truncate=5.0)
        assert rms(smooth(image, width) - expected) < 0.03 * rms(expected)


def test_pixels_within_four_widths_of_a_sample_are_reached() -> None:
    counts = np.zeros((64, 64))
    counts[32, 32] = 1.0
    reached = find_reached(counts, 2.0)
    assert reached[32, 40]
    assert not reached[32, 41]
