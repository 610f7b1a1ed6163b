"""The table of a measured law holds in the range of the motion to which it was fitted."""

from __future__ import annotations

import numpy as np
import pytest

from estimation.candidate_terms.discrepancy import DISCREPANCY_TERMS
from estimation.device_fit.data import prepare_run
from estimation.device_fit.fit import Likelihood, fit_model
from estimation.device_fit.initial import flat_whiteners
from estimation.device_fit.model import Model
from estimation.device_fit.parameters import Candidate
from estimation.diagnosis.discrepancy_law import measured_law_table
from scanner.device import Axis, Device
from scanner.recording import Recording
from scanner.stages import Mechanics, Position
from scanner.terms.measured_law import beyond


def test_the_range_of_a_measured_law_contains_the_whole_motion() -> None:
    """A decay is larger than its 99 % quantile during the first periods."""
    rate, resonance = 2e4, 2 * np.pi * 1e3
    axis = Axis(Mechanics(1.0, 100.0, resonance**2), readout=Position(1.0, 1e-3), name="x")
    time = np.arange(4000) / rate
    decay = 0.1 * np.exp(-50.0 * time) * np.cos(resonance * time)
    device = Device("beam", {"x": axis})
    measured = decay + 1e-3 * np.random.default_rng(1).normal(size=time.size)
    run = prepare_run(Recording.from_arrays({"sense_x": (measured, "V", rate, 0.0)}, device), device)
    model = Model([run], device, [Candidate(DISCREPANCY_TERMS["free-mechanics"], "x", "sense")])
    x = np.zeros(len(model.parameters))
    x[model.indices("start")] = 0.1 / run.scales["x"].amplitude, 0.0
    table = measured_law_table(fit_model(Likelihood([run], flat_whiteners(model)), model, x))
    assert table is not None
    assert run.scales["x"].amplitude < 0.098
    assert table["upper"] == pytest.approx([0.1, 0.1 * resonance], rel=0.02)
    quadrature = 0.1 * np.exp(-50.0 * time) * np.sin(resonance * time)
    assert beyond(table, [decay, -resonance * quadrature]) < 0.01
