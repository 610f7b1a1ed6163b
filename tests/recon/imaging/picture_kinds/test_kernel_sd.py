"""The variance of kernel-weighted pictures: what the kernel removes, in visited and unvisited pixels."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from recon.imaging.picture_kinds.held_out import SplitSums
from recon.imaging.picture_kinds.kernel_picture import kernel_picture
from recon.imaging.picture_kinds.kernel_sd import detail_variance, weigh_samples
from recon.imaging.pixel_noise import SampleNoise
from scanner.arrays import Array

SIZE = 128
WIDTH_PX = 1.5


def texture(seed: int) -> Array:
    scene = gaussian_filter(np.random.default_rng(seed).normal(size=(SIZE, SIZE)), 2.0)
    return np.asarray(scene / scene.std())


def samples_of(scene: Array, visited: Array, noise_sd: float, held: Array, seed: int) -> SplitSums:
    counts = visited.astype(float)
    sums = counts * (scene + np.random.default_rng(100 + seed).normal(scale=noise_sd, size=scene.shape))
    return SplitSums(sums, counts, held * sums, held * counts)


def ratio_of_variances(scene: Array, samples: SplitSums, noise_sd: float, part: Array) -> float:
    """Stated variance of ``part`` over the squared error."""
    estimate = kernel_picture(samples, SampleNoise(noise_sd**2, 0.0, 0.0), WIDTH_PX)
    part = part & np.isfinite(estimate.sd)
    return float(np.mean(estimate.sd[part] ** 2) / np.mean((estimate.image - scene)[part] ** 2))


def test_the_variance_is_that_of_the_errors_in_visited_and_unvisited_pixels() -> None:
    """A fifth more is stated for samples that lie anywhere in their pixels; here they lie at the centres."""
    rng = np.random.default_rng(0)
    for seed in range(3):
        scene, visited = texture(seed), rng.random((SIZE, SIZE)) < 0.4
        samples = samples_of(scene, visited, 0.3, visited & (rng.random(visited.shape) < 0.1), seed)
        for part in (visited, ~visited):
            assert ratio_of_variances(scene, samples, 0.3, part) == pytest.approx(1.2, abs=0.25)


def test_the_variance_hardly_depends_on_the_samples_that_are_held_out() -> None:
    rng = np.random.default_rng(1)
    scene, visited = texture(5), np.ones((SIZE, SIZE), bool)
    noise = SampleNoise(0.5**2, 0.0, 0.0)
    medians = []
    for _ in range(6):
        samples = samples_of(scene, visited, 0.5, rng.random(visited.shape) < 0.05, seed=2)
        full = weigh_samples(samples.sums, samples.counts, noise, WIDTH_PX)
        medians.append(np.median(detail_variance(samples, noise, WIDTH_PX, full)))
    assert np.std(medians) < 0.02 * np.mean(medians)


def test_gaps_between_lines_err_more_than_their_visited_neighbours_show() -> None:
    """Every sixth row of a scene that varies across the rows is visited, and its noise is the same along a row."""
    rng = np.random.default_rng(3)
    rows = gaussian_filter(rng.normal(size=SIZE), 3.0)
    scene = np.repeat((rows / rows.std())[:, None], SIZE, axis=1) + 0.05 * texture(4)
    visited = np.zeros((SIZE, SIZE), bool)
    visited[::6] = True
    held = np.zeros_like(visited)
    for row in range(0, SIZE, 6):
        begin = rng.integers(0, SIZE - 40)
        held[row, begin : begin + 40] = True
    samples = samples_of(scene, visited, 0.05, held, seed=5)
    assert ratio_of_variances(scene, samples, 0.05, ~visited) > 0.4
