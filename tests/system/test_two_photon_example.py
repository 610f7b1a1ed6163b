"""The lag between scan directions follows the speed of a resonant scan, in a measured and a simulated frame."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))

from two_photon import (
    column_positions,
    constant_shift,
    fit_law,
    fitted_rows,
    phase_from_samples,
    rms,
    row_differences,
    shift_by_speed,
    shift_rows,
)


@pytest.mark.slow
def test_the_lag_of_a_measured_frame_follows_the_scan_speed(measured_data: Path) -> None:
    frame = np.load(measured_data / "two_photon_bidirectional/raw.npy").astype(np.float64)
    x, held_out = column_positions(frame), ~fitted_rows(len(frame))
    errors = {}
    for law, start in ((constant_shift, [4.4]), (shift_by_speed, [0.01, 300.0])):
        p = fit_law(frame, law, start)
        errors[law] = rms(row_differences(shift_rows(frame, law(p, x)))[held_out])
    assert errors[shift_by_speed] < 10.5 < 18.0 < errors[constant_shift] < 100.0 < rms(row_differences(frame)[held_out])
    phase, sd = phase_from_samples(frame, p[1])
    assert sd < 2e-4
    assert phase == pytest.approx(p[0], abs=1e-4 + 1.96 * sd)


def test_rows_and_samples_recover_the_phase_error_of_a_simulated_frame() -> None:
    from scipy.ndimage import gaussian_filter

    rng = np.random.default_rng(3)
    scene = gaussian_filter(rng.normal(size=(256, 256)), 4.0)
    x, half_width, phase = column_positions(scene), 140.0, 0.02
    column = np.arange(256.0)
    frame = np.empty_like(scene)
    for i, row in enumerate(scene):  # exact, while the fitted law is of first order
        forward = 1 if i % 2 == 0 else -1
        position = half_width * np.sin(np.arcsin(x / half_width) - forward * phase)
        frame[i] = np.interp(position + 127.5, column, row)
    p = fit_law(frame, shift_by_speed, [0.01, 160.0])
    assert p == pytest.approx([phase, half_width], rel=0.03)
    assert phase_from_samples(frame, half_width)[0] == pytest.approx(phase, rel=0.03)
