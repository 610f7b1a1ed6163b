"""Noise of the picture's gradient is no information on a displacement."""

import numpy as np
import pytest

from recon.imaging.sample_motion.block_equations import PARTS, block_equations
from recon.imaging.sample_motion.gradient_noise import calibrate_gradients
from recon.imaging.sample_motion.rigid_motion import estimate_sample_motion
from tests.support.sample_motion import BLOCKS, PERIOD, PIXELS, error_of, scan

SIDE = PIXELS + 64
DOWN, ACROSS = np.mgrid[:SIDE, :SIDE].astype(float)


def few_beads() -> np.ndarray:
    """Nine beads of 3.5 pixels in the field before a dark background."""
    rng = np.random.default_rng(5)
    cells = np.stack(np.meshgrid(*[np.arange(16.0, SIDE, 32.0)] * 2), axis=-1).reshape(-1, 2)
    places, peaks = cells + rng.uniform(-8.0, 8.0, cells.shape), rng.uniform(0.4, 1.0, len(cells))
    spots = [
        peak * np.exp(-0.5 * ((ACROSS - x) ** 2 + (DOWN - y) ** 2) / 1.5**2)
        for (x, y), peak in zip(places, peaks, strict=True)
    ]
    return np.asarray(0.02 + np.sum(spots, axis=0))


@pytest.mark.parametrize(("width", "least"), [(0.7, 0.6), (1.4, 0.85)])
def test_the_information_is_the_slope_of_the_score(width: float, least: float) -> None:
    """0.70 and 0.90; with the square of the noisy gradient 0.51 and 0.81.

    A displacement that differs between blocks: the picture of the others hardly follows it.
    """
    samples = scan(np.zeros((2, 2)), 10.0, 4 * BLOCKS, few_beads())
    part = round(PERIOD / PARTS)
    blocks = -(-samples.x.size // (part * PARTS))
    moved = 0.2 * np.random.default_rng(0).standard_normal((blocks, 2))
    shift = np.repeat(moved, PARTS, axis=0)
    later, earlier, rest = (
        block_equations(samples, sign * shift, part, (PIXELS, PIXELS), width) for sign in (1.0, -1.0, 0.0)
    )
    slope = 0.5 * np.sum((earlier.score - later.score)[:, :2] * moved)
    information = np.einsum("bi,bij,bj->", moved, rest.information[:, :2, :2], moved)
    assert least < slope / information < 1.1


@pytest.mark.parametrize("photons", [30.0, 100.0])
def test_few_beads_that_drift_are_followed_within_the_standard_deviation(photons: float) -> None:
    """With the square of the noisy gradient the error is 1.3 of the stated one."""
    displacement = np.linspace(0.0, 3.0, 500)[:, None] * [1.0, -0.5]
    found = estimate_sample_motion(scan(displacement, photons, picture=few_beads()), PERIOD, (PIXELS, PIXELS))
    assert found is not None
    assert found.moving
    error = error_of(found, displacement)
    error -= error.mean(axis=0)
    assert np.sqrt(np.mean(error**2) / np.mean(found.sd**2)) < 1.1


def test_the_gradient_of_an_edge_remains_and_noise_along_it_does_not() -> None:
    rng = np.random.default_rng(8)
    references = np.zeros((8, 40, 40, 5), np.float32)
    parts = np.sqrt(7.0) * rng.standard_normal((8, 40, 40, 2))
    references[..., 3:] = (parts.sum(axis=0) - parts) / 7.0
    references[:, :, 18:22, 3] += 10.0
    references[:, :3, :3, 3:] = np.nan
    calibrate_gradients(references)
    edge = references[:, 5:-5, 18:22]
    assert edge[..., 3].mean() == pytest.approx(10.0, rel=0.05)
    assert np.mean(edge[..., 4] ** 2) < 0.2
    assert np.mean(references[:, 5:-5, :3, 3:] ** 2) < 0.2
    assert np.isnan(references[:, :3, :3, 3:]).all()


@pytest.mark.filterwarnings("error")
def test_gradients_of_a_small_unit_are_calibrated_alike() -> None:
    """Squares of gradients of 1e-20 are below single precision; their ratios are not."""
    rng = np.random.default_rng(2)
    scene, noise = rng.standard_normal((20, 20, 5)), rng.standard_normal((8, 20, 20, 5))
    small = (1e-20 * (scene * [1.0, 1.0, 1.0, 1.0, 0.3] + 0.2 * noise)).astype(np.float32)
    calibrate_gradients(small)
    assert np.isfinite(small).all()
    assert np.abs(small).max() < 1e-18
