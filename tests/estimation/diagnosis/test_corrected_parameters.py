"""Intervals of a law's parameters beside physics that no law describes."""

from __future__ import annotations

import numpy as np
import pytest

from estimation.candidate_terms.linearisation import linear_model_of_corrections
from estimation.diagnosis.corrected_parameters import correct_parameters
from estimation.diagnosis.finding import parameter_estimates
from tests.support.bench import bench_recording
from tests.support.cubic_spring import K3, LARGEST_ANGLE, LAW, fit_cubic_stiffness


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
