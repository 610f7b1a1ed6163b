"""The lag between scan directions follows the speed of a resonant scan, in a measured and a simulated frame."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))

from two_photon import (
    between_rows,
    constant,
    fitted,
    following_speed,
    from_middle,
    phase_by_samples,
    rms,
    seen_rows,
    straightened,
)


@pytest.mark.slow
def test_the_lag_of_a_measured_frame_follows_the_scan_speed(measured_data: Path) -> None:
    frame = np.load(measured_data / "two_photon_bidirectional/raw.npy").astype(np.float64)
    x, unseen = from_middle(frame), ~seen_rows(len(frame))
    left = {}
    for law, start in ((constant, [4.4]), (following_speed, [0.01, 300.0])):
        p = fitted(frame, law, start)
        left[law] = rms(between_rows(straightened(frame, law(p, x)))[unseen])
    assert left[following_speed] < 10.5 < 18.0 < left[constant] < 100.0 < rms(between_rows(frame)[unseen])
    phase, sd = phase_by_samples(frame, p[1])
    assert sd < 2e-4
    assert phase == pytest.approx(p[0], abs=1e-4 + 1.96 * sd)


def test_rows_and_samples_recover_the_phase_error_of_a_simulated_frame() -> None:
    from scipy.ndimage import gaussian_filter

    rng = np.random.default_rng(3)
    scene = gaussian_filter(rng.normal(size=(256, 256)), 4.0)
    x, swing, phase = from_middle(scene), 140.0, 0.02
    column = np.arange(256.0)
    frame = np.empty_like(scene)
    for i, row in enumerate(scene):  # exact, while the fitted law is of first order
        forward = 1 if i % 2 == 0 else -1
        seen = swing * np.sin(np.arcsin(x / swing) - forward * phase)
        frame[i] = np.interp(seen + 127.5, column, row)
    p = fitted(frame, following_speed, [0.01, 160.0])
    assert p == pytest.approx([phase, swing], rel=0.03)
    assert phase_by_samples(frame, swing)[0] == pytest.approx(phase, rel=0.03)
