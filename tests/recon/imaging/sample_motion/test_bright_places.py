"""Scenes whose noise and detail lie in few places, and lattices: what looks like a motion of the sample there."""

import numpy as np
import pytest

from recon.imaging.sample_motion.coarse_search import search_motion
from recon.imaging.sample_motion.residual_noise import fit_residual_noise
from recon.imaging.sample_motion.rigid_motion import MIN_LOG_LIKELIHOOD_GAIN, estimate_sample_motion
from tests.support.sample_motion import BLOCKS, PERIOD, PIXELS, beads, error_of, scan

SIDE = PIXELS + 64
DOWN, ACROSS = np.mgrid[:SIDE, :SIDE].astype(float)


def many_beads() -> np.ndarray:
    """Fluorescent beads of 3 pixels before a background of a fiftieth of their brightness."""
    return beads(24, sd=1.3)


def edge() -> np.ndarray:
    """A straight edge between dark and bright."""
    return np.asarray(np.where(0.955 * ACROSS + 0.295 * DOWN > 0.62 * SIDE, 1.0, 0.05))


def checker() -> np.ndarray:
    """Squares that repeat by 13 and 17 pixels together."""
    return np.asarray(0.1 + 0.9 * ((ACROSS // 13 + DOWN // 17) % 2))


@pytest.mark.parametrize("picture", [many_beads, edge])
def test_bright_places_at_rest_are_reported_at_rest(picture) -> None:  # type: ignore[no-untyped-def]
    samples = scan(np.zeros((2, 2)), 1000.0, 2 * BLOCKS, picture())
    found = estimate_sample_motion(samples, PERIOD, (PIXELS, PIXELS))
    assert found is not None
    assert not found.moving
    assert found.gain < 0.5 * MIN_LOG_LIKELIHOOD_GAIN


def test_beads_that_vibrate_in_x_rest_in_y() -> None:
    time = np.linspace(0.0, 2.0 * np.pi * 6.0, 20 * BLOCKS)
    displacement = np.column_stack([np.sin(time), np.zeros_like(time)])
    found = estimate_sample_motion(scan(displacement, 100.0, picture=many_beads()), PERIOD, (PIXELS, PIXELS))
    assert found is not None
    assert found.moving
    x, y = np.sqrt(np.mean(error_of(found, displacement) ** 2, axis=0))
    assert x < 0.2
    assert y < 0.1


def test_a_lattice_that_drifts_does_not_slip_by_a_period() -> None:
    displacement = np.linspace(0.0, 6.0, 500)[:, None] * [1.0, -0.5]
    found = estimate_sample_motion(scan(displacement, 50.0, picture=checker()), PERIOD, (PIXELS, PIXELS))
    assert found is not None
    assert np.sqrt(np.mean(error_of(found, displacement) ** 2)) < 0.1


@pytest.mark.parametrize("picture", [many_beads, edge, checker, lambda: np.full((SIDE, SIDE), 0.5)])
def test_the_search_leaves_a_sample_at_rest(picture) -> None:  # type: ignore[no-untyped-def]
    samples = scan(np.zeros((2, 2)), 200.0, picture=picture())
    found = search_motion(samples, round(12 * PERIOD), BLOCKS // 12, (PIXELS, PIXELS))
    assert np.ptp(found, axis=0).max() < 2.0


def test_the_noise_law_is_that_of_the_residuals() -> None:
    """Few bright samples beside many dark ones, with a variance of 2 + 3 (f - dark) + 0.5 g²."""
    rng = np.random.default_rng(3)
    expected = np.where(rng.random(60000) < 0.03, rng.uniform(0.0, 100.0, 60000), 0.0)
    gradient = 0.2 * expected**2 * rng.random(60000)
    residual = rng.standard_normal(60000) * np.sqrt(2.0 + 3.0 * expected + 0.5 * gradient)
    noise = fit_residual_noise(expected, gradient, residual)
    assert noise.floor == pytest.approx(2.0, rel=0.03)
    assert noise.slope == pytest.approx(3.0, rel=0.15)
    assert noise.place == pytest.approx(0.5, rel=0.15)
