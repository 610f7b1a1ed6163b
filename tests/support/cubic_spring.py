"""The bench with a cubic spring, and the fit that finds it."""

from __future__ import annotations

import numpy as np

from estimation.device_fit.data import prepare_run
from estimation.device_fit.fit import Fit, Likelihood, fit_model
from estimation.device_fit.initial import (
    estimate_whiteners,
    fit_progressively,
    flat_whiteners,
    window_schedule,
)
from estimation.device_fit.model import Model
from estimation.device_fit.parameters import Candidate
from scanner.recording import Recording
from scanner.terms import catalogue
from tests.support.bench import DEVICE, STIFFNESS, bench_signals

LARGEST_ANGLE = float(np.abs(bench_signals(0.0, 0.0)[1]).max())
"""Of the bench without a cubic spring [rad]."""

K3 = 0.06 * STIFFNESS / LARGEST_ANGLE**2
"""Cubic stiffness [N m/rad^3]."""

LAW = Candidate(catalogue()["cubic-stiffness"], "x", "sense")


def fit_cubic_stiffness(recording: Recording) -> tuple[Likelihood, Fit]:
    """The fit of the nominal device with a cubic stiffness, under the noise that it leaves."""
    run = prepare_run(recording, DEVICE)
    nominal = Model([run], DEVICE)
    likelihood, stops = Likelihood([run], flat_whiteners(nominal)), window_schedule(nominal)
    early = fit_progressively(likelihood, nominal, stops)[-1]
    model = Model([run], DEVICE, [LAW], nominal.mains)
    fit = fit_model(likelihood, model, model.map_parameters_from(early.model, early.x))
    likelihood = Likelihood([run], estimate_whiteners(fit.model, fit.x))
    return likelihood, fit_model(likelihood, fit.model, fit.x)
