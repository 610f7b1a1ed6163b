"""A planned ringdown of the device on the test bench, and its perfect fit."""

from __future__ import annotations

import numpy as np

from estimation.device_fit.fit import Fit, Likelihood, linearise_simulated
from estimation.device_fit.initial import stated_whitener
from estimation.device_fit.model import Model
from estimation.device_fit.parameters import Candidate
from phantoms.waveforms import Constant
from recon.experiment_planning import Excitation, prepare_planned_run
from scanner.terms import catalogue
from tests.support.bench import DEVICE

RINGDOWN = prepare_planned_run(Excitation("down", {"x": Constant(0.0)}, {"x": 4e-3}, 0.06, 40e3), DEVICE)


def perfect_fit(effect: str | None) -> tuple[Likelihood, Fit]:
    """The ringdown of the device with one effect of natural size or none, and its perfect fit."""
    model = Model([RINGDOWN], DEVICE, [Candidate(catalogue()[effect], "x", "sense")] if effect else [])
    x = np.zeros(len(model.parameters))
    start = model.index("start", "x", "angle", 0)
    assert start is not None
    x[start] = 1.0
    x[model.indices("term")] = 1.0
    return linearise_simulated(model, x, [[stated_whitener(output) for output in RINGDOWN.outputs]])
