"""A motion that is not there predicts the samples less well than rest."""

import numpy as np
import pytest

from recon.imaging.sample_motion.block_equations import PARTS, sample_log_likelihoods
from recon.imaging.sample_motion.rigid_motion import estimate_sample_motion
from tests.support.sample_motion import BLOCKS, PERIOD, PIXELS, scan

SIDE = PIXELS + 64
DOWN, ACROSS = np.mgrid[:SIDE, :SIDE].astype(float)


def eight_beads() -> np.ndarray:
    """Beads of 3.5 pixels, some of them outside the field, before a dark background."""
    rng = np.random.default_rng(7)
    places, peaks = rng.uniform(0, SIDE, (8, 2)), rng.uniform(0.3, 1.0, 8)
    spots = [
        peak * np.exp(-0.5 * ((ACROSS - x) ** 2 + (DOWN - y) ** 2) / 1.5**2)
        for (x, y), peak in zip(places, peaks, strict=True)
    ]
    return np.asarray(0.02 + np.sum(spots, axis=0))


def test_few_beads_at_rest_are_reported_at_rest() -> None:
    """Their detail agrees with a motion that the picture follows, with a gain of 22 in the equations around it."""
    found = estimate_sample_motion(scan(np.zeros((2, 2)), 300.0, 2 * BLOCKS, eight_beads()), PERIOD, (PIXELS, PIXELS))
    assert found is not None
    assert not found.moving
    assert not found.shift.any()


@pytest.mark.parametrize("size", [0.0, 1.0])
def test_the_true_motion_has_the_larger_likelihood(size: float) -> None:
    samples = scan(np.array([[-0.5, 0.25], [0.5, -0.25]]) * size, 300.0)
    part = round(PERIOD / PARTS)
    blocks = -(-samples.x.size // (part * PARTS))
    moved = np.linspace(-0.5, 0.5, blocks * PARTS)[:, None] * [1.0, -0.5]
    of_motion, of_rest = (
        sample_log_likelihoods(samples, shift, part, (PIXELS, PIXELS), 1.0) for shift in (moved, 0.0 * moved)
    )
    gain = float(np.nansum(of_motion - of_rest, dtype=float))
    assert (gain > 0.0) == (size > 0.0)
