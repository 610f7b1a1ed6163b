"""The peaks of a sine in the steps of a converter, which is clipped or not."""

import numpy as np
import pytest

from recon.quality.defects import find_defects
from scanner.recording import Recording
from tests.support.position_scan import DEVICE

RATE_HZ, STEPS = 1e6, 100.0


@pytest.mark.parametrize("noise_steps", [0.0, 0.1, 0.4])
@pytest.mark.parametrize("amplitude_steps", [99.6, 99.9, 100.2, 100.4])
@pytest.mark.parametrize(("rail", "is_clipped"), [(np.inf, False), (90.0, True)])
def test_only_a_rail_counts_as_clipped(
    noise_steps: float, amplitude_steps: float, rail: float, is_clipped: bool
) -> None:
    """A sine of 100 steps, as in a converter of 8 bits, stands for many samples at its largest value."""
    rng, time = np.random.default_rng(0), np.arange(40_000) / RATE_HZ
    sine = amplitude_steps * np.sin(2 * np.pi * 1234.5 * time) + rng.normal(0.0, noise_steps, time.size)
    channels = {
        "sense_x": (np.clip(np.round(sine), -rail, rail) / STEPS, "V", RATE_HZ),
        "intensity": (rng.normal(size=time.size), "V", RATE_HZ),
    }
    found = find_defects(Recording.from_arrays(channels, DEVICE), DEVICE)
    assert any(defect.kind == "clipped" for defect in found) == is_clipped
