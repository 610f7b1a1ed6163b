"""Fits that follow the motion: discrepancy terms over growing windows, and the fits that they consist of."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.polynomial.chebyshev import chebval
from scipy.integrate import solve_ivp

from estimation.candidate_terms.anchor import MAX_RESIDUAL_RATIO, fit_anchor, fit_growing, residual_ratio
from estimation.candidate_terms.discrepancy import DISCREPANCY_TERMS, FORCE_POWERS, N_FORCE_POWERS, cosine_series
from estimation.candidate_terms.screening import ProfiledLinearModel, all_candidates, damped_start, predict_gain
from estimation.device_fit.data import prepare_run
from estimation.device_fit.fit import Fit, Likelihood, fit_model, fit_models
from estimation.device_fit.initial import fit_initial_state, fit_progressively, flat_whiteners, window_schedule
from estimation.device_fit.model import Model
from estimation.device_fit.parameters import Candidate
from estimation.diagnosis.law_selection import choose_laws
from scanner.device import Axis, Device
from scanner.integrator.abi import Nominal
from scanner.recording import Recording
from scanner.stages import Mechanics
from scanner.terms import catalogue
from tests.support.bench import DEVICE, STIFFNESS, bench_recording, bench_signals


def hardening_decay() -> tuple[Device, Recording]:
    """A free decay of 100 periods whose spring is 20 % stiffer at full swing than the nominal one."""
    stiffness, rate = (2 * np.pi * 50.0) ** 2, 2500.0

    def law(t: float, y: np.ndarray) -> list[float]:
        return [y[1], -stiffness * y[0] * (1.0 + 20.0 * y[0] ** 2) - 3.0 * y[1]]

    time_s = np.arange(0.0, 2.0, 1 / rate)
    angle = solve_ivp(law, (0.0, 2.0), [0.1, 0.0], t_eval=time_s, rtol=1e-9, atol=1e-11).y[0]
    axis = Axis(Mechanics(1.0, 3.0, stiffness), name="x", tolerance={"J": 1e-9, "b": 0.2})
    device = Device("decay", {"x": axis})
    noisy = angle + np.random.default_rng(3).normal(0.0, 2e-4, angle.size)
    return device, Recording.from_arrays({"angle_x": (noisy, "rad", rate, 0.0)}, device=device)


def decaying_fit(late_phase: float) -> tuple[Likelihood, Fit]:
    """A decay over 40 periods, and a fit whose phase is off by ``late_phase`` [rad] in the last eighth."""
    time = np.linspace(0.0, 40.0, 4001)
    phase = 2 * np.pi * time
    data = np.exp(-time / 10.0) * np.cos(phase)
    signal = np.exp(-time / 10.0) * np.cos(phase + late_phase * (time > 35.0))
    scales = SimpleNamespace(rate=2 * np.pi, k=1.0, J=1.0 / (2 * np.pi) ** 2)
    run = SimpleNamespace(outputs=[SimpleNamespace(data=data, guard=(0, 0))], duration=40.0, scales={"x": scales})
    model = SimpleNamespace(runs=[run], outputs=lambda x, stop: [[signal]])
    likelihood = SimpleNamespace(whiteners=[[SimpleNamespace(noise_variance=1e-8)]])
    return likelihood, SimpleNamespace(model=model, x=np.zeros(0))  # type: ignore[return-value]


@pytest.mark.parametrize("late_phase", [0.0, 0.05, 0.4])
def test_a_phase_that_is_lost_late_in_a_decay_counts_as_lost(late_phase: float) -> None:
    likelihood, fit = decaying_fit(late_phase)
    assert residual_ratio(likelihood, fit) == pytest.approx(2.0 * np.sin(late_phase / 2.0), abs=0.01)


def test_a_diverged_motion_is_not_followed() -> None:
    likelihood, fit = decaying_fit(0.0)
    fit.model.outputs = lambda x, stop: [[np.full(4001, 1e200)]]  # type: ignore[method-assign, assignment, misc]
    assert residual_ratio(likelihood, fit) == np.inf


@pytest.mark.slow
def test_a_drifting_stiffness_follows_the_motion_of_a_spring() -> None:
    device, recording = hardening_decay()
    run = prepare_run(recording, device)
    nominal = Model([run], device)
    likelihood, stops = Likelihood([run], flat_whiteners(nominal)), window_schedule(nominal)
    early = fit_progressively(likelihood, nominal, stops)
    assert residual_ratio(likelihood, early[-1]) > 3.0 * MAX_RESIDUAL_RATIO
    drift = Candidate(DISCREPANCY_TERMS["free-stiffness"], "x", "sense")
    anchor, _ = fit_anchor(likelihood, early[-1], early, stops, [[drift]])
    assert [candidate.key for candidate in anchor.model.candidates] == [drift.key]
    assert residual_ratio(likelihood, anchor) < MAX_RESIDUAL_RATIO
    pool = all_candidates(nominal, [*catalogue().values(), *DISCREPANCY_TERMS.values()])
    choice = choose_laws(anchor, early[-1], pool, lambda text: None)
    assert choice is not None
    assert [candidate.term.effect for candidate in choice.fit.model.candidates] == ["cubic-stiffness"]
    (size,) = choice.fit.model.values(choice.fit.model.candidates[0], choice.fit.x)
    assert size == pytest.approx(20.0 * (2 * np.pi * 50.0) ** 2, rel=0.1)  # the angle's gain is known to 2 %


def test_a_growing_fit_ends_at_the_first_window_that_is_worse_than_another_fit_of_the_whole() -> None:
    device, recording = hardening_decay()
    nominal = Model([prepare_run(recording, device)], device)
    likelihood, (first, *_) = Likelihood(nominal.runs, flat_whiteners(nominal)), window_schedule(nominal)
    whole = fit_growing(likelihood, nominal, np.zeros(len(nominal.parameters)), first)
    aborted = fit_growing(likelihood, nominal, np.zeros(len(nominal.parameters)), first, abort_above=0.001 * whole.chi2)
    assert 0.001 * whole.chi2 < aborted.chi2 <= whole.chi2
    assert np.count_nonzero(aborted.rows) < np.count_nonzero(whole.rows)


@pytest.mark.slow
def test_a_motion_that_is_lost_in_held_out_samples_alone_is_followed() -> None:
    """The fits over the second window predict the third twentieth, which none uses, with the opposite phase."""
    size = np.abs(bench_signals(0.0, 0.0)[1]).max()
    run = prepare_run(bench_recording(k3=0.3 * STIFFNESS / size**2, seed=6), DEVICE)
    nominal = Model([run], DEVICE)
    likelihood, stops = Likelihood([run], flat_whiteners(nominal)), window_schedule(nominal)
    early = fit_progressively(likelihood, nominal, stops)
    terms = [Candidate(catalogue()[name], "x", "sense") for name in ("cubic-stiffness", "quadratic-drag")]
    anchor, _ = fit_anchor(likelihood, early[-1], early, stops, [terms])
    assert residual_ratio(likelihood, anchor) < MAX_RESIDUAL_RATIO


def test_a_nominal_device_that_follows_the_motion_is_the_anchor() -> None:
    run = prepare_run(bench_recording(seed=9), DEVICE)
    nominal = Model([run], DEVICE)
    likelihood, stops = Likelihood([run], flat_whiteners(nominal)), window_schedule(nominal)
    early = fit_progressively(likelihood, nominal, stops)
    terms = [Candidate(DISCREPANCY_TERMS["free-stiffness"], "x", "sense")]
    assert fit_anchor(likelihood, early[-1], early, stops, [terms]) == (early[-1], [])


def test_a_step_that_raises_the_misfit_is_shortened() -> None:
    run = prepare_run(bench_recording(seed=9), DEVICE)
    model = Model([run], DEVICE)
    likelihood, stop = Likelihood([run], flat_whiteners(model)), window_schedule(model)[0]
    fit = fit_initial_state(likelihood, model, stop)
    fit = fit_model(likelihood, model, fit.x, max_iterations=20)
    step = np.zeros(fit.x.size)
    step[0] = 3.0
    start = damped_start(likelihood, fit, model, fit.x, step)
    assert 0.0 < start[0] - fit.x[0] < 3.0
    tiny = 1e-6 * step
    np.testing.assert_array_equal(damped_start(likelihood, fit, model, fit.x, tiny), fit.x + tiny)


def test_a_diverged_motion_predicts_no_gain() -> None:
    model = SimpleNamespace(precision=np.ones(2))
    diverged = SimpleNamespace(
        jacobian=np.full((3, 2), 1e20), residual=np.full(3, 1e6), rows=np.ones(3, bool), x=np.zeros(2), model=model
    )
    known = ProfiledLinearModel(diverged)  # type: ignore[arg-type]
    assert predict_gain(*known.normal_equations(np.ones((3, 1)))[:2])[0] == 0.0


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
    np.testing.assert_array_equal(cosine_series(turn, [*sizes, 0.0, 0.0]), cosine_series(turn, sizes))
    np.testing.assert_array_equal(cosine_series(turn, np.zeros(numbers)), np.zeros(turn.shape))


@pytest.mark.parametrize("k", range(N_FORCE_POWERS))
def test_force_polynomial_has_the_stated_powers(k: int) -> None:
    """Each coefficient multiplies its power of angle and rate, in units of the amplitude and its rate."""
    amplitude, rate, angle, velocity, stiffness = 0.2, 5.0, 0.13, 0.7, 3.0
    term = DISCREPANCY_TERMS["free-mechanics"]
    coefficients = np.zeros(len(term.parameters))
    coefficients[:3] = amplitude, rate, 1.0
    coefficients[3 + k] = 1.0
    nominal = Nominal(1.0, 1.0, stiffness, 1.0, 1.0, 0.0, 0.0)
    torque, *_ = term.torque(0.0, angle, velocity, 0.0, 0.0, 0.0, 0.0, coefficients, nominal)  # type: ignore[misc]
    i, j = FORCE_POWERS[k]
    expected = -stiffness * amplitude * (angle / amplitude) ** i * (velocity / (amplitude * rate)) ** j
    assert torque == pytest.approx(expected, rel=1e-12)
