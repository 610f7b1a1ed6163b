"""A motion that is not there predicts the samples less well than rest."""

import numpy as np
import pytest

from recon.imaging.sample_motion.block_equations import PARTS, sample_log_likelihoods
from recon.imaging.sample_motion.rigid_motion import estimate_sample_motion
from tests.support.sample_motion import BLOCKS, PERIOD, PIXELS, beads, scan


def test_few_beads_at_rest_are_reported_at_rest() -> None:
    """Their detail agrees with a motion that the picture follows, with a gain of 22 in the equations around it."""
    found = estimate_sample_motion(
        scan(np.zeros((2, 2)), 300.0, 2 * BLOCKS, beads(8, sd=1.5)), PERIOD, (PIXELS, PIXELS)
    )
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
