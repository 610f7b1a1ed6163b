"""The pictures of a diagnosis: the law, where the residual stands, and what the missing physics costs a picture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_planning import STAGE

from estimation.mismatch.fit import Comparison, Fit
from estimation.mismatch.model import Candidate, Model
from estimation.mismatch.sensitivity import linearised, stated_whitener
from phantoms.waveforms import Constant
from recon.evidence import CELLS, HALF_LINE, law, paths, phase_cost, portrait
from recon.planning import Excitation, planned_run
from scanner.terms import catalogue

RUN = planned_run(Excitation("down", {"x": Constant(0.0)}, {"x": 4e-3}, 0.06, 40e3), STAGE)


def fitted(effect: str | None, channel: str = "sense") -> tuple[Comparison, Fit]:
    """A ringdown of a device with one effect of natural size, and its perfect fit."""
    candidates = [Candidate(catalogue()[effect], "x", channel)] if effect else []
    model = Model([RUN], STAGE, candidates)
    x = np.zeros(len(model.free))
    start = model.index("start", "x", "angle", 0)
    assert start is not None
    x[start] = 1.0
    x[[i for i, f in enumerate(model.free) if f.kind == "term"]] = 1.0
    return linearised(model, x, [[stated_whitener(output) for output in RUN.outputs]])


def test_the_law_of_a_cubic_spring_is_drawn_over_the_angle() -> None:
    _, fit = fitted("cubic-stiffness")
    (candidate,) = fit.model.candidates
    shown = law(fit, candidate)
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
        ("sensor-cubic", "angle (mrad)", "change of the sense signal (V)"),
    ],
)
def test_a_law_is_drawn_over_what_it_follows(effect: str, variable: str, quantity: str) -> None:
    _, fit = fitted(effect)
    shown = law(fit, fit.model.candidates[0])
    assert shown is not None
    assert (shown.x_label, shown.y_label) == (variable, quantity)


def test_a_law_with_a_memory_is_not_drawn() -> None:
    _, fit = fitted("viscoelastic")
    assert law(fit, fit.model.candidates[0]) is None


def test_a_residual_stands_where_the_mirror_was_when_it_arose() -> None:
    comparison, fit = fitted(None)
    own = paths(fit, fit.x, 0)["x"]
    at = comparison.time * RUN.outputs[0].data.size * RUN.outputs[0].stride
    angle = np.interp(at, np.arange(own.angle.size), own.angle)
    right, flat = portrait(comparison, fit, [np.where(angle > 0.0, 3.0, 1.0), np.full(angle.size, 2.0)], 0, 0)
    assert np.nanmin(right[:, CELLS // 2 + 1 :]) == 3.0
    assert np.nanmax(right[:, : CELLS // 2 - 1]) == 1.0
    assert np.isnan(flat[0, 0])  # a motion that fills no corner
    assert np.nanmax(np.abs(flat - 2.0)) < 1e-12


def test_a_spring_that_is_off_costs_a_phase_that_grows() -> None:
    _, fit = fitted(None)
    at = fit.model.index("nominal", "x", "mechanics.k")
    assert at is not None
    x = fit.x.copy()
    x[at] = 0.02  # tolerances of 1 %
    cost = phase_cost(replace(fit, x=x), fit, "x", 0)
    assert cost is not None
    rate = STAGE.axis("x").resonance * 2 * np.pi
    np.testing.assert_allclose(cost.before, 0.5 * 0.02 * 0.01 * rate * cost.time, atol=2e-3)
    assert cost.pixels(cost.before) == pytest.approx(HALF_LINE * np.sqrt(np.mean(cost.before**2)))
    assert 0.0 < cost.after.max() < 0.1
