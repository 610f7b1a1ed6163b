"""The residual over the state, the phase error and the waveform of a fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from estimation.device_fit.posterior import (
    PORTRAIT_CELLS,
    phase_error,
    phase_portrait,
    waveform,
)
from tests.support.bench import DEVICE
from tests.support.ringdown import RINGDOWN, perfect_fit


def test_the_portrait_shows_a_residual_at_the_state_of_the_mirror() -> None:
    likelihood, fit = perfect_fit(None)
    trajectory = fit.model.trajectories(0, fit.x)["x"]
    at = likelihood.time * RINGDOWN.outputs[0].data.size * RINGDOWN.outputs[0].stride
    angle = np.interp(at, np.arange(trajectory.angle.size), trajectory.angle)
    right, flat = phase_portrait(likelihood, fit, [np.where(angle > 0.0, 3.0, 1.0), np.full(angle.size, 2.0)], 0, 0)
    assert np.nanmin(right[:, PORTRAIT_CELLS // 2 + 1 :]) == 3.0
    assert np.nanmax(right[:, : PORTRAIT_CELLS // 2 - 1]) == 1.0
    assert np.isnan(flat[0, 0])  # the motion never reaches the corner
    assert np.nanmax(np.abs(flat - 2.0)) < 1e-12


def test_a_stiffness_error_gives_a_growing_phase_error() -> None:
    _, fit = perfect_fit(None)
    at = fit.model.index("nominal", "x", "mechanics.k")
    assert at is not None
    x = fit.x.copy()
    x[at] = 0.02  # tolerances of 1 %
    cost = phase_error(replace(fit, x=x), fit, "x", 0)
    assert cost is not None
    rate = DEVICE.axis("x").resonance * 2 * np.pi
    np.testing.assert_allclose(cost.before, 0.5 * 0.02 * 0.01 * rate * cost.time, atol=2e-3)
    assert 0.0 < cost.after.max() < 0.1


def test_the_waveform_shows_the_segment_with_the_largest_residual() -> None:
    _, fit = perfect_fit(None)
    x = fit.x.copy()
    x[fit.model.index("nominal", "x", "mechanics.k")] = 0.02
    shown = waveform(replace(fit, x=x), fit, 0, 0)
    assert shown.time.size == shown.measured.size == shown.before.size == shown.after.size == 120
    rms = [np.sqrt(np.mean((shown.measured - each) ** 2)) for each in (shown.before, shown.after)]
    assert rms[0] > 10.0 * rms[1]
