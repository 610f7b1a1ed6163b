"""The curve of an effect, the residual over the state, the phase error and the waveform of a fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimation.device_fit.fit import Fit, Likelihood
from estimation.device_fit.model import Model
from estimation.device_fit.parameters import Candidate
from estimation.device_fit.posterior import (
    PICTURE_HALF_WIDTH_PX,
    PORTRAIT_CELLS,
    axis_trajectories,
    phase_error,
    phase_portrait,
    waveform,
)
from estimation.diagnosis.effect_curve import effect_curve
from estimation.diagnosis.identifiability import linearise_simulated, stated_whitener
from phantoms.waveforms import Constant
from recon.experiment_planning import Excitation, prepare_planned_run
from scanner.terms import catalogue
from tests.support.bench import DEVICE

RUN = prepare_planned_run(Excitation("down", {"x": Constant(0.0)}, {"x": 4e-3}, 0.06, 40e3), DEVICE)


def fitted(effect: str | None, channel: str = "sense") -> tuple[Likelihood, Fit]:
    """A ringdown of a device with one effect of natural size, and its perfect fit."""
    candidates = [Candidate(catalogue()[effect], "x", channel)] if effect else []
    model = Model([RUN], DEVICE, candidates)
    x = np.zeros(len(model.parameters))
    start = model.index("start", "x", "angle", 0)
    assert start is not None
    x[start] = 1.0
    x[[i for i, f in enumerate(model.parameters) if f.kind == "term"]] = 1.0
    return linearise_simulated(model, x, [[stated_whitener(output) for output in RUN.outputs]])


def test_the_curve_of_a_cubic_spring_is_over_the_angle() -> None:
    _, fit = fitted("cubic-stiffness")
    (candidate,) = fit.model.candidates
    shown = effect_curve(fit, candidate)
    assert shown is not None
    assert (shown.x_label, shown.y_label) == ("angle (mrad)", "extra torque (N m)")
    (k3,) = fit.model.values(candidate, fit.x)
    true = -k3 * (1e-3 * shown.x) ** 3
    np.testing.assert_allclose(shown.y, true, atol=0.02 * np.abs(true).max())
    assert np.all(shown.band[0] <= shown.band[1])
    at = fit.model.index("term", candidate.key, "k3")
    half = 0.5 * np.ptp(shown.band[:, -1]) / abs(shown.y[-1])
    assert half == pytest.approx(1.96 * np.sqrt(fit.covariance[at, at]), rel=0.4)  # of 40 draws


@pytest.mark.parametrize(
    ("effect", "variable", "quantity"),
    [
        ("quadratic-drag", "rate (rad/s)", "extra torque (N m)"),
        ("offset-drift", "time (ms)", "change of the sense signal (V)"),
        ("sensor-cubic", "level of the sense signal (V)", "change of the sense signal (V)"),
        ("resonance-drift", "time (ms)", "change of stiffness (%)"),
        ("damping-drift", "time (ms)", "change of damping (%)"),
        ("gain-drift", "time (ms)", "change of gain (%)"),
        ("readout-lag", "frequency (kHz)", "phase shift (°)"),
        ("channel-delay", "time (ms)", "shift in time (µs)"),
    ],
)
def test_a_curve_is_over_the_variable_that_explains_the_effect(effect: str, variable: str, quantity: str) -> None:
    _, fit = fitted(effect)
    shown = effect_curve(fit, fit.model.candidates[0])
    assert shown is not None
    assert (shown.x_label, shown.y_label) == (variable, quantity)


def test_an_effect_with_internal_state_has_no_curve() -> None:
    _, fit = fitted("viscoelastic")
    assert effect_curve(fit, fit.model.candidates[0]) is None


def test_the_portrait_shows_a_residual_at_the_state_of_the_mirror() -> None:
    likelihood, fit = fitted(None)
    trajectory = axis_trajectories(fit, fit.x, 0)["x"]
    at = likelihood.time * RUN.outputs[0].data.size * RUN.outputs[0].stride
    angle = np.interp(at, np.arange(trajectory.angle.size), trajectory.angle)
    right, flat = phase_portrait(likelihood, fit, [np.where(angle > 0.0, 3.0, 1.0), np.full(angle.size, 2.0)], 0, 0)
    assert np.nanmin(right[:, PORTRAIT_CELLS // 2 + 1 :]) == 3.0
    assert np.nanmax(right[:, : PORTRAIT_CELLS // 2 - 1]) == 1.0
    assert np.isnan(flat[0, 0])  # the motion never reaches the corner
    assert np.nanmax(np.abs(flat - 2.0)) < 1e-12


def test_a_stiffness_error_gives_a_growing_phase_error() -> None:
    _, fit = fitted(None)
    at = fit.model.index("nominal", "x", "mechanics.k")
    assert at is not None
    x = fit.x.copy()
    x[at] = 0.02  # tolerances of 1 %
    cost = phase_error(replace(fit, x=x), fit, "x", 0)
    assert cost is not None
    rate = DEVICE.axis("x").resonance * 2 * np.pi
    np.testing.assert_allclose(cost.before, 0.5 * 0.02 * 0.01 * rate * cost.time, atol=2e-3)
    assert cost.blur_px(cost.before) == pytest.approx(PICTURE_HALF_WIDTH_PX * np.sqrt(np.mean(cost.before**2)))
    assert 0.0 < cost.after.max() < 0.1


def test_the_waveform_shows_the_segment_with_the_largest_residual() -> None:
    _, fit = fitted(None)
    x = fit.x.copy()
    x[fit.model.index("nominal", "x", "mechanics.k")] = 0.02
    shown = waveform(replace(fit, x=x), fit, 0, 0)
    assert shown.time.size == shown.measured.size == shown.before.size == shown.after.size == 120
    rms = [np.sqrt(np.mean((shown.measured - each) ** 2)) for each in (shown.before, shown.after)]
    assert rms[0] > 10.0 * rms[1]
