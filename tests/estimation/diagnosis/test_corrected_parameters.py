"""Intervals of a law's parameters beside physics that no law describes."""

from __future__ import annotations

import numpy as np
import pytest

from estimation.candidate_terms.linearisation import linear_model_of_corrections
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
from estimation.diagnosis.corrected_parameters import correct_parameters
from estimation.diagnosis.finding import parameter_estimates
from scanner.recording import Recording
from scanner.terms import catalogue
from tests.support.bench import DEVICE, STIFFNESS, bench_recording, bench_signals

LARGEST_ANGLE = float(np.abs(bench_signals(0.0, 0.0)[1]).max())
K3 = 0.06 * STIFFNESS / LARGEST_ANGLE**2
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


@pytest.mark.slow
@pytest.mark.parametrize(
    "imperfection",
    [{"backlash": 0.02 * LARGEST_ANGLE}, {"backlash": 0.1 * LARGEST_ANGLE},
     {"delay": 1e-6, "delay_time_constant": 1e-4}],
)  # fmt: skip
def test_an_interval_beside_an_unlisted_effect_contains_the_truth(imperfection: dict[str, float]) -> None:
    likelihood, fit = fit_cubic_stiffness(bench_recording(k3=K3, seed=4, **imperfection))
    (alone,) = parameter_estimates(likelihood, fit, LAW, None)
    assert not alone.ci95[0] < K3 < alone.ci95[1]
    (beside,) = parameter_estimates(
        likelihood, fit, LAW, correct_parameters(fit, linear_model_of_corrections(likelihood, fit))
    )
    assert beside.ci95[0] < K3 < beside.ci95[1]
    assert beside.value == alone.value


@pytest.mark.slow
def test_corrections_hardly_widen_the_interval_of_a_complete_model() -> None:
    likelihood, fit = fit_cubic_stiffness(bench_recording(k3=K3, seed=4))
    corrected = correct_parameters(fit, linear_model_of_corrections(likelihood, fit))
    sd = np.sqrt(np.diag(fit.covariance))
    at = fit.model.index("term", LAW.key, "k3")
    assert at is not None
    assert abs(corrected.mean[at] - fit.x[at]) < 0.3 * sd[at]
    assert 1.0 <= corrected.sd[at] / sd[at] < 1.2
