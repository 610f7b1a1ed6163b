"""The standard deviation of posterior pictures: its scale, the centres of pixels, and the unresolved variance."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import fft
from scipy.ndimage import gaussian_filter, map_coordinates

from recon.imaging.picture_kinds.held_out import SplitSums
from recon.imaging.picture_kinds.posterior_picture import posterior_picture
from recon.imaging.picture_kinds.posterior_sd import PRIOR_LOG_SD, measure_scale, variance_at_centres
from recon.imaging.picture_kinds.scene_covariance import measure_covariance, unresolved_variance
from recon.imaging.picture_kinds.stationary_prior import CentreDetail, stationary_mean
from recon.imaging.pixel_noise import SampleNoise, measure_sample_noise
from scanner.arrays import Array

SIZE = 128


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def held_out_errors(error_sd: float, noise_sd: float, seed: int = 0) -> tuple[SplitSums, Array]:
    """Samples of a scene of zeros, a tenth of them held out, and a picture with independent errors."""
    rng = np.random.default_rng(seed)
    counts = (rng.random((SIZE, SIZE)) < 0.5).astype(float)
    held = counts * (rng.random(counts.shape) < 0.2)
    sums = counts * rng.normal(scale=noise_sd, size=counts.shape)
    return SplitSums(sums, counts, held * sums, held), rng.normal(scale=error_sd, size=counts.shape)


def test_the_scale_is_that_of_the_errors_where_they_exceed_the_noise() -> None:
    samples, picture = held_out_errors(error_sd=3.0, noise_sd=1.0)
    ones = np.ones((SIZE, SIZE))
    for expected in (9.0, 3.0, 20.0):
        assert measure_scale(samples, picture, ones, ones, expected) == pytest.approx(9.0, rel=0.15)


def test_the_scale_is_the_expected_one_where_the_noise_hides_the_errors() -> None:
    samples, picture = held_out_errors(error_sd=1.0, noise_sd=10.0)
    ones = np.ones((SIZE, SIZE))
    for expected in (0.5, 2.0):
        scale = measure_scale(samples, picture, 0.01 * ones, ones, expected)
        assert abs(np.log(scale / expected)) < PRIOR_LOG_SD
    nothing_held = samples._replace(held_sums=0.0 * ones, held_counts=0.0 * ones)
    assert measure_scale(nothing_held, picture, ones, ones, 2.0) == pytest.approx(2.0, rel=0.01)


def test_the_dense_part_of_a_scan_does_not_determine_the_scale_alone() -> None:
    """A third of the field holds nine tenths of the samples, and has a tenth of the error variance."""
    rng = np.random.default_rng(1)
    dense = np.arange(SIZE) < SIZE // 3
    counts = rng.poisson(np.where(dense, 1.0, 0.05) * np.ones((SIZE, 1))).astype(float)
    held = counts * (rng.random(counts.shape) < 0.3)
    sums = 0.1 * counts * rng.normal(size=counts.shape)
    picture = rng.normal(size=counts.shape) * np.where(dense, np.sqrt(0.1), 1.0)
    ones = np.ones(counts.shape)
    scale = measure_scale(SplitSums(sums, counts, held * sums, held), picture, 100.0 * ones, ones, 0.5)
    assert scale == pytest.approx(0.7, rel=0.2)  # a third of 0.1 and two thirds of 1


def test_the_variance_at_centres_is_that_of_correlated_normal_numbers() -> None:
    """Expectation of the samples and value at the centre are drawn together; the picture estimates the former."""
    variance, precision, detail = 2.0, 1.5, CentreDetail(1.6, 1.2)
    found, share = variance_at_centres(np.array(variance), np.array(precision), detail)
    left = variance / (1.0 + variance * precision)  # given the pixel's own samples too
    assert share == pytest.approx(precision * left)
    without_own = detail.variance * left + share * variance * detail.covariance**2
    covariance = [[variance, detail.covariance * variance], [detail.covariance * variance, without_own]]
    rng = np.random.default_rng(2)
    expectation, centre = rng.multivariate_normal([0.0, 0.0], covariance, 200_000).T
    picture = share * (expectation + rng.normal(scale=precision**-0.5, size=expectation.size))
    assert np.mean((picture - centre) ** 2) == pytest.approx(float(found), rel=0.02)
    unvisited, no_share = variance_at_centres(np.array(variance), np.array(0.0), detail)
    assert (unvisited, no_share) == (variance * detail.variance, 0.0)


@pytest.mark.parametrize("length", [3.0, 8.0])
def test_the_unresolved_variance_is_that_of_the_best_linear_estimate(length: float) -> None:
    """A scene with the covariance exp(-distance / length), of which every third pixel is visited."""
    rng = np.random.default_rng(3)
    wave_number = np.pi * np.arange(SIZE) / SIZE
    spectrum = 2.0 * np.pi * length**2 * (1.0 + length**2 * np.add.outer(wave_number**2, wave_number**2)) ** -1.5
    scene = fft.idctn(np.sqrt(spectrum) * rng.normal(size=spectrum.shape), norm="ortho")
    counts = (rng.random(scene.shape) < 1 / 3).astype(float)
    noise_sd = 0.5
    means = counts * (scene + rng.normal(scale=noise_sd, size=scene.shape))
    precision = counts / noise_sd**2
    error = scene - stationary_mean(means, precision, spectrum, 0.0)
    stated = unresolved_variance(measure_covariance(means, counts), precision).mean()
    assert stated == pytest.approx(np.mean(error**2), rel=0.25)


def test_intervals_of_a_texture_as_fine_as_the_pixels_hold_the_centres() -> None:
    """Samples lie anywhere in a pixel, between whose centre and theirs the texture varies more than the noise."""
    rng = np.random.default_rng(4)
    scene = gaussian_filter(rng.normal(size=(SIZE, SIZE)), 0.7)
    scene /= scene.std()
    count, noise_sd = 16_000, 0.3
    row, column = rng.uniform(0.0, SIZE, (2, count))
    values = map_coordinates(scene, [row - 0.5, column - 0.5], order=1, mode="nearest")
    values += rng.normal(scale=noise_sd, size=count)
    pixel = row.astype(int) * SIZE + column.astype(int)

    def images(part: slice) -> list[Array]:
        sums = np.bincount(pixel[part], values[part], SIZE**2), np.bincount(pixel[part], minlength=SIZE**2)
        return [each.reshape(SIZE, SIZE).astype(float) for each in sums]

    samples = SplitSums(*images(slice(None)), *images(slice(0, None, 10)))
    noise = measure_sample_noise(pixel, values)
    assert noise is not None
    estimate = posterior_picture(samples, noise)
    inside = np.abs(estimate.image - scene) < 1.96 * estimate.sd
    for part in (samples.counts > 0, samples.counts == 0):
        assert 0.93 < inside[part].mean() < 0.97


def test_a_bright_background_does_not_change_the_picture() -> None:
    rng = np.random.default_rng(5)
    scene = np.where(gaussian_filter(rng.normal(size=(SIZE, SIZE)), 6.0) > 0, 1.0, 0.0)
    counts = (rng.random(scene.shape) < 0.3).astype(float)
    held = counts * (rng.random(scene.shape) < 0.1)
    noisy = counts * (scene + rng.normal(scale=0.3, size=scene.shape))
    dark, bright = (
        posterior_picture(SplitSums(sums, counts, held * sums, held), SampleNoise(0.09, 0.0, 0.0)).image
        for sums in (noisy, noisy + 100.0 * counts)
    )
    assert rms(bright - 100.0 - dark) < 0.1 * rms(dark - scene)


def test_the_unit_of_the_intensity_does_not_change_the_picture_or_its_deviation() -> None:
    """In units of 1e-15, as a current of femtoamperes has in A, the deviation was 15 times too large."""
    rng, unit = np.random.default_rng(5), 1e-15
    scene = np.where(gaussian_filter(rng.normal(size=(SIZE, SIZE)), 6.0) > 0, 1.0, 0.0)
    counts = (rng.random(scene.shape) < 0.3).astype(float)
    held = counts * (rng.random(scene.shape) < 0.1)
    noisy = counts * (scene + rng.normal(scale=0.3, size=scene.shape))
    usual, small = (
        posterior_picture(SplitSums(sums, counts, held * sums, held), SampleNoise(0.09 * each**2, 0.0, 0.0))
        for each, sums in ((1.0, noisy), (unit, unit * noisy))
    )
    np.testing.assert_allclose(small.image / unit, usual.image, atol=1e-3)
    np.testing.assert_allclose(small.sd / unit, usual.sd, rtol=0.01)
