"""The curve of an effect in the report."""

from __future__ import annotations

import numpy as np
import pytest

from estimation.device_fit.data import prepare_run
from estimation.device_fit.fit import Likelihood, linearise_at
from estimation.device_fit.initial import flat_whiteners
from estimation.device_fit.model import Model
from estimation.device_fit.parameters import Candidate
from recon.report.effect_curve import effect_curve
from scanner.terms import catalogue
from tests.support.ringdown import perfect_fit
from tests.support.simulated import shared_electrode


def test_the_curve_of_a_cubic_spring_is_over_the_angle() -> None:
    _, fit = perfect_fit("cubic-stiffness")
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
    _, fit = perfect_fit(effect)
    shown = effect_curve(fit, fit.model.candidates[0])
    assert shown is not None
    assert (shown.x_label, shown.y_label) == (variable, quantity)


def test_an_effect_with_internal_state_has_no_curve() -> None:
    _, fit = perfect_fit("viscoelastic")
    assert effect_curve(fit, fit.model.candidates[0]) is None


@pytest.mark.parametrize(
    ("effect", "variable", "quantity"),
    [
        ("sensor-cubic", "level of the sense signal (V)", "change of the sense signal (V)"),
        ("gain-drift", "time (ms)", "change of gain (%)"),
    ],
)
def test_the_curve_of_a_readout_that_two_axes_share_is_of_their_sum(effect: str, variable: str, quantity: str) -> None:
    recording, _ = shared_electrode()
    assert recording.device is not None
    run = prepare_run(recording, recording.device)
    candidate = Candidate(catalogue()[effect], "y", "sense")
    model = Model([run], recording.device, [candidate], mains=())
    x = np.zeros(len(model.parameters))
    starts = [i for i, spec in enumerate(model.parameters) if spec.kind == "start" and spec.name == "angle"]
    x[starts] = 0.7
    level = model.outputs(x)[0][0]
    x[model.indices("term")] = 0.1
    shown = effect_curve(linearise_at(Likelihood([run], flat_whiteners(model)), model, x), candidate)
    assert shown is not None
    assert (shown.x_label, shown.y_label) == (variable, quantity)
    if effect == "sensor-cubic":
        assert [shown.x[0], shown.x[-1]] == pytest.approx([level.min(), level.max()], abs=0.05 * np.ptp(level))
    else:
        np.testing.assert_allclose(shown.y, 1.2 * shown.x / shown.x[-1], atol=0.05)
