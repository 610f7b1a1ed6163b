"""Drifting resonances that nominal values absorb: laws are sought around the stated values."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.blind.generator import Case
from estimation.candidate_terms.screening import all_candidates
from estimation.candidate_terms.significance import UNIQUE_NAME_THRESHOLD, residual_is_noise
from estimation.device_fit.data import prepare_run
from estimation.device_fit.fit import Likelihood, fit_model, nominal_values_are_improbable
from estimation.device_fit.initial import fit_progressively, flat_whiteners, window_schedule
from estimation.device_fit.model import Model
from estimation.diagnosis.from_stated_values import fit_in_another_minimum
from scanner.terms import catalogue
from tests.support.bench import DEVICE, bench_recording
from tests.support.blind_recordings import search_blind_recording

RIVALS = ("drive-droop", "coulomb-friction", "inertia-scale", "cubic-stiffness", "quadratic-drag")


def test_a_device_in_a_wrong_minimum_is_fitted_again_from_its_fit_with_drifts() -> None:
    """The wrong minimum is a fit that was stopped at a stiffness many tolerances too high."""
    run = prepare_run(bench_recording(), DEVICE)
    model = Model([run], DEVICE)
    likelihood = Likelihood([run], flat_whiteners(model))
    right = fit_model(likelihood, model, fit_progressively(likelihood, model, window_schedule(model))[-1].x)
    wrong = fit_model(
        likelihood, model, right.x + 50.0 * np.eye(right.x.size)[model.indices("nominal")[2]], max_iterations=0
    )
    drift = [c for c in all_candidates(model, catalogue().values()) if c.term.effect == "resonance-drift"]
    with_drift = model.with_candidates(drift)
    drifting = fit_model(likelihood, with_drift, with_drift.map_parameters_from(model, right.x))
    assert residual_is_noise(right)
    assert not residual_is_noise(wrong)
    found = fit_in_another_minimum(likelihood, wrong, [drifting])
    assert found is not None
    np.testing.assert_allclose(found.x, right.x, atol=0.05)
    assert fit_in_another_minimum(likelihood, right, [drifting]) is None
    assert fit_in_another_minimum(likelihood, wrong, []) is None


@pytest.mark.slow
def test_drifts_of_both_axes_are_found_although_nominal_values_absorb_them(tmp_path: Path) -> None:
    """The nominal values move by tens of tolerances, and around them other laws take the place of the drifts."""
    case = Case("blind-001", "one", "imaging", ("drive-droop", "resonance-drift"), "white", 3977966624)
    blind, search = search_blind_recording(case, tmp_path, (*RIVALS, "resonance-drift"))
    assert nominal_values_are_improbable(search.nominal)
    found = {selected.candidate.axis: selected.candidate for selected in search.steps}
    assert [found[axis].term.effect for axis in "xy"] == ["resonance-drift", "resonance-drift"]
    assert not nominal_values_are_improbable(search.final)
    assert search.final.validation_chi2 == pytest.approx(1.0, abs=0.05)
    at = search.final.model.index("term", found["x"].key, "alpha")
    assert at is not None
    value = search.final.model.values(found["x"], search.final.x)[0]
    sd = np.sqrt(search.final.covariance[at, at]) * abs(value / search.final.x[at])
    assert value == pytest.approx(blind.truth.dk, abs=4.0 * sd)


@pytest.mark.slow
def test_a_clock_beside_two_drifts_is_found_although_nominal_values_absorb_it_beside_the_drifts(tmp_path: Path) -> None:
    """The clock of x runs 6.6 ppm slow. Beside the drifts alone, the nominal values are improbable too."""
    case = Case("blind-001", "one", "imaging", ("clock-skew", "resonance-drift"), "proportional", 3793513552)
    _, search = search_blind_recording(case, tmp_path, ("feedthrough", "clock-skew", "resonance-drift"))
    assert nominal_values_are_improbable(search.nominal)
    assert {step.candidate.key for step in search.steps} == {"x.resonance-drift", "y.resonance-drift", "x.clock-skew"}
    assert not nominal_values_are_improbable(search.final)


@pytest.mark.slow
def test_a_clock_is_found_where_drifting_resonances_alone_do_not_follow_the_motion(tmp_path: Path) -> None:
    """The clock of x runs 34 ppm slow. Drifting resonances and dampings follow what it does to amplitude and phase."""
    case = Case("blind-008", "one", "imaging", ("clock-skew", "resonance-drift"), "coloured", 2309866996)
    terms = ("filter-lag", "drive-lag", "charging", "damping-drift", "clock-skew", "resonance-drift")
    _, search = search_blind_recording(case, tmp_path, terms)
    assert {step.candidate.key for step in search.steps} == {"x.resonance-drift", "y.resonance-drift", "x.clock-skew"}


@pytest.mark.slow
def test_a_lag_of_the_drive_is_found_beside_drifts_in_slow_noise(tmp_path: Path) -> None:
    """In 1/f noise a fit that follows the motion leaves a tenth of the signal, as the first window alone does.

    A delay of the readout fits the signal as well, and is a rival.
    """
    case = Case("blind-003", "one", "imaging", ("drive-lag", "resonance-drift"), "flicker", 2089980223)
    terms = ("channel-delay", "readout-lag", "drive-lag", "damping-drift", "resonance-drift")
    _, search = search_blind_recording(case, tmp_path, terms)
    found = {step.candidate.key: step for step in search.steps}
    (late,) = found.keys() - {"x.resonance-drift", "y.resonance-drift"}
    assert len(found) == 3
    near = {rival.candidate.key for rival in found[late].rivals if rival.evidence_gap < UNIQUE_NAME_THRESHOLD}
    assert {"x.drive-lag", "x.channel-delay"} <= {late, *near}
    assert not nominal_values_are_improbable(search.final)


@pytest.mark.slow
def test_a_clock_alone_is_found_where_drifts_of_both_axes_follow_what_it_does(tmp_path: Path) -> None:
    """The clock of x runs 53 ppm slow. From the four drifts that imitate it, no addition or exchange leads to it."""
    case = Case("blind-003", "one", "imaging", ("clock-skew",), "coloured", 2054680291)
    _, search = search_blind_recording(case, tmp_path, tuple(catalogue()))
    assert [step.candidate.key for step in search.steps] == ["x.clock-skew"]
