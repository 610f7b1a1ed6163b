"""Choices by held-out samples: the weight of a second picture, and the width of a kernel."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from recon.imaging.held_out import SplitSums, shrunk_weight
from recon.imaging.kernel_picture import choose_width
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
