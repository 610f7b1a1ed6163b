"""The progressive fit: which candidates are kept and which are dropped as the fitted segment grows."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.polynomial.chebyshev import chebval

from estimation.diagnosis.data import prepare_run
from estimation.diagnosis.discrepancy import cosine_series
from estimation.diagnosis.fit import Likelihood, fit_model, fit_models
from estimation.diagnosis.initial import fit_initial_state, flat_whiteners, window_schedule
from estimation.diagnosis.model import Model
from estimation.diagnosis.parameters import Candidate
from estimation.diagnosis.progressive_fit import (
    ABORT_MARGIN,
    DUPLICATE_DISTANCE_SIGMA2,
    MIN_NOISE_CHI2,
    PRUNE_MARGIN,
    _deduplicate,
    _dominated,
    _flip_sign,
    _prune,
)
from estimation.diagnosis.screening import ProfiledLinearModel, linear_gain
from scanner.terms import catalogue
from tests.support.bench import DEVICE, bench_recording


def test_the_mirrored_start_of_a_mode_changes_only_the_signs_of_the_mode() -> None:
    model = Model(
        [prepare_run(bench_recording(), DEVICE)], DEVICE, [Candidate(catalogue()["second-mode"], "x", "sense")]
    )
    fit = SimpleNamespace(model=model, x=np.linspace(-0.9, -0.1, len(model.parameters)))
    changed = _flip_sign(fit) != fit.x  # type: ignore[arg-type]
    assert [f.name for f, turned in zip(model.parameters, changed, strict=True) if turned] == ["c", "0", "1"]


def test_candidates_that_fit_a_window_equally_well_are_kept() -> None:
    def fit(evidence: float, chi2: float) -> SimpleNamespace:
        model = SimpleNamespace(parameters=[], candidates=[])
        return SimpleNamespace(
            model=model, x=np.zeros(0), neg2_log_evidence=evidence, chi2=chi2, rows=np.ones(1000, bool)
        )

    penalty = 2.0 * PRUNE_MARGIN  # of the nominal values
    fits = [fit(1000.0, 990.0), fit(1000.0 + penalty, 995.0), fit(1000.0 + penalty, 1100.0), fit(9000.0, 8990.0)]
    kept_models = [each.model for each in fits[:2]]
    assert [model for model, _ in _prune(fits[:3], False, True)] == kept_models  # type: ignore[arg-type]
    lost = [fit(each.neg2_log_evidence + 5000.0, each.chi2 + 5000.0) for each in fits[:3]]
    assert len(_prune(lost, False, True)) == 1  # type: ignore[arg-type]


def test_a_fit_with_a_larger_misfit_than_the_complete_rival_is_dropped() -> None:
    likelihood = SimpleNamespace(rows=np.ones(20_000, bool))
    rival = SimpleNamespace(neg2_log_evidence=20_300.0, residual=np.ones(20_000))
    fitted_rows = np.arange(20_000) < 8000
    least = 8000.0 + ABORT_MARGIN + 300.0 + (1.0 - MIN_NOISE_CHI2) * 12_000
    for chi2, beaten in ((least - 1.0, False), (least + 1.0, True)):
        fit = SimpleNamespace(rows=fitted_rows, chi2=chi2)
        assert _dominated(likelihood, fit, rival) is beaten  # type: ignore[arg-type]
    assert not _dominated(likelihood, fit, None)  # type: ignore[arg-type]


def test_a_diverged_motion_predicts_no_gain() -> None:
    free = [SimpleNamespace(kind="nominal", owner="x")] * 2
    model = SimpleNamespace(parameters=free, precision=np.ones(2))
    diverged = SimpleNamespace(jacobian=np.full((3, 2), 1e20), residual=np.full(3, 1e6), x=np.zeros(2), model=model)
    known = ProfiledLinearModel(diverged, np.ones(3, bool))  # type: ignore[arg-type]
    assert linear_gain(*known.normal_equations(np.ones((3, 1)))[:2])[0] == 0.0


def test_starts_of_one_candidate_that_converged_to_one_fit_are_merged() -> None:
    def fit(key: str, residual: np.ndarray) -> SimpleNamespace:
        model = SimpleNamespace(candidates=[SimpleNamespace(key=key)])
        return SimpleNamespace(model=model, residual=residual, rows=np.arange(100) < 90)

    first = np.random.default_rng(0).normal(size=100)
    near, far = first.copy(), first.copy()
    near[:90] += 0.9 * np.sqrt(DUPLICATE_DISTANCE_SIGMA2 / 90)
    near[90:] += 9.0  # outside the fitted window
    far[:90] -= 1.1 * np.sqrt(DUPLICATE_DISTANCE_SIGMA2 / 90)
    fits = [fit("mode", first), fit("mode", near), fit("law", first), fit("mode", far)]
    assert list(_deduplicate(fits)) == [fits[0], fits[2], fits[3]]  # type: ignore[arg-type]


def test_parallel_fits_equal_sequential_fits() -> None:
    run = prepare_run(bench_recording(k3=2.0, seed=9), DEVICE)
    nominal = Model([run], DEVICE)
    likelihood, stop = Likelihood([run], flat_whiteners(nominal)), window_schedule(nominal)[0]
    x = fit_initial_state(likelihood, nominal, stop).x
    models = [Model([run], DEVICE, [Candidate(catalogue()[name], "x", "sense")]) for name in
              ("cubic-stiffness", "quadratic-drag", "second-mode")]  # fmt: skip
    starts = [(model, model.map_parameters_from(nominal, x)) for model in [*models, models[0]]]
    for start, fit in zip(starts, fit_models(likelihood, starts, stop, max_iterations=3), strict=True):
        alone = fit_model(likelihood, *start, stop, 3)
        np.testing.assert_array_equal(fit.x, alone.x)
        assert fit.neg2_log_evidence == alone.neg2_log_evidence


@pytest.mark.parametrize("numbers", [1, 2, 9, 24])
def test_cosine_series_equals_chebyshev_evaluation(numbers: int) -> None:
    rng = np.random.default_rng(numbers)
    turn, sizes = rng.uniform(0.0, np.pi, (700, 3)), rng.normal(size=numbers)
    np.testing.assert_allclose(cosine_series(turn, sizes), chebval(np.cos(turn), sizes), rtol=0, atol=1e-12)
    np.testing.assert_allclose(
        cosine_series(turn, sizes), np.cos(np.multiply.outer(turn, range(numbers))) @ sizes, atol=1e-12
    )
