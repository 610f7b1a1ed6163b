"""Choices by held-out samples: the weight of a second picture, and the width of a kernel."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from recon.imaging.picture_kinds.held_out import (
    SplitSums,
    held_out_ranges,
    hold_out_neighbours,
    sample_distance,
    shrunk_weight,
)
from recon.imaging.picture_kinds.kernel_picture import choose_width
from recon.imaging.pixel_noise import SampleNoise


def test_a_weight_that_is_not_determined_is_smaller_than_that_of_least_squares() -> None:
    rng = np.random.default_rng(0)
    errors = []
    for _ in range(200):
        difference = rng.normal(size=300)
        noise = rng.normal(scale=10.0, size=300)
        weight = shrunk_weight(difference, difference, noise)  # which explains nothing
        fitted = max(float(difference @ noise / (difference @ difference)), 0.0)
        assert 0.0 <= weight <= min(fitted, 1.0)
        errors.append((weight**2, min(fitted, 1.0) ** 2))
    shrunk, least_squares = np.mean(errors, axis=0)
    assert shrunk < 0.6 * least_squares


def test_a_weight_that_is_determined_is_that_of_least_squares() -> None:
    rng = np.random.default_rng(1)
    difference = rng.normal(size=2000)
    for true in (0.3, 0.9, 1.5):
        found = shrunk_weight(difference, difference, true * difference + rng.normal(scale=0.5, size=2000))
        assert found == pytest.approx(min(true, 1.0), abs=0.05)
    assert shrunk_weight(0.0 * difference, 0.0 * difference, difference) == 0.0


def test_the_width_of_a_kernel_hardly_depends_on_the_samples_that_are_held_out() -> None:
    """A scene with little contrast, whose held-out samples alone leave the width open by a factor of 3."""
    rng = np.random.default_rng(2)
    scene = gaussian_filter(rng.normal(size=(128, 128)), 3.0)
    counts = (rng.random(scene.shape) < 0.2).astype(float)
    sums = counts * (0.3 * scene / scene.std() + rng.normal(size=scene.shape))
    widths = []
    for _ in range(20):
        held = counts * (rng.random(counts.shape) < 0.1)
        widths.append(choose_width(SplitSums(sums, counts, held * sums, held), SampleNoise(1.0, 0.0, 0.0)))
    assert max(widths) < 1.5 * min(widths)


def lines(offset: float) -> SplitSums:
    """Samples along lines, forth and then back ``offset`` pixels beside them, with segments held out."""
    across, down = np.meshgrid(np.arange(0, 256, 0.5), np.arange(4.0, 256.0, 24.0))
    x, y = (np.concatenate([forth.ravel(), back.ravel()]) for forth, back in ((across, across), (down, down + offset)))
    pixel = y.astype(int) % 256 * 256 + x.astype(int)
    held = np.concatenate([np.arange(*part) for part in held_out_ranges(0, pixel.size)])
    counts, held_counts = (np.bincount(each, minlength=256**2).reshape(256, 256) * 1.0 for each in (pixel, pixel[held]))
    return SplitSums(3.0 * counts, counts, 3.0 * held_counts, held_counts)


def test_held_out_pixels_lie_in_gaps_where_a_scan_retraces_its_lines() -> None:
    """Held-out pixels beside a second pass are nearer to samples than the pixels of the picture are."""
    for offset in (0.0, 1.0):
        before, after = lines(offset), hold_out_neighbours(lines(offset))
        assert np.array_equal(after.counts, before.counts)
        assert np.array_equal(after.held_sums, 3.0 * after.held_counts)
        of_gaps = sample_distance(before.counts).mean()
        near, far = (sample_distance(each.kept_counts)[each.held_counts > 0].mean() for each in (before, after))
        assert near < of_gaps / 3.0
        assert far > of_gaps / 2.0
        assert 0.05 < after.held_counts.sum() / after.counts.sum() < 0.25
    evenly_spaced = lines(12.0)
    assert hold_out_neighbours(evenly_spaced) is evenly_spaced
