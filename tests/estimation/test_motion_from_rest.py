"""The phase of a motion that begins within the recording, after blocks that hold noise only."""

import numpy as np
import pytest

from estimation.reference import absolute_reference

BLOCK_S, FREQUENCY_HZ, REST_BLOCKS = 2e-3, 2000.0, 10


@pytest.mark.parametrize("seed", range(5))
def test_noise_before_a_motion_gives_its_phase_no_slope(seed: int) -> None:
    """A slope of a turn a block would be a frequency that is wrong by 500 Hz."""
    random = np.random.default_rng(seed)
    time = BLOCK_S * (np.arange(60) + 0.5)
    growth = np.where(np.arange(60) < REST_BLOCKS, 0.0, 1.0 - np.exp(-(np.arange(60) - REST_BLOCKS) / 8.0))
    noise = 1e-4 * (random.standard_normal(60) + 1j * random.standard_normal(60))
    phasors = growth * np.exp(1j * (2 * np.pi * FREQUENCY_HZ * time - 1.2)) + noise
    phase = absolute_reference(FREQUENCY_HZ, 0.0, 0.12).relative_phase(time, phasors)
    moving = growth > 0.0
    assert phase[moving] == pytest.approx(-1.2, abs=0.01)
    assert np.all(np.abs(phase[~moving] + 1.2) <= np.pi + 0.01)
