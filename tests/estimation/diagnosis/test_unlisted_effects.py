"""An effect that is not in the catalogue is reported as unknown, with its stage and its measured curve."""

from __future__ import annotations

import numpy as np
import pytest

from estimation.diagnosis.data import prepare_run
from estimation.diagnosis.diagnose import diagnose
from estimation.diagnosis.discrepancy import DISCREPANCY_TERMS
from estimation.diagnosis.fit import Fit, Likelihood, fit_model
from estimation.diagnosis.initial import fit_initial_state, fit_progressively, flat_whiteners, window_schedule
from estimation.diagnosis.model import Model
from estimation.diagnosis.parameters import Candidate
from estimation.diagnosis.selection import SelectionState, _replace_terms_by_discrepancy
from scanner.recording import Recording
from scanner.terms import catalogue
from tests.support.bench import DEVICE, RESONANCE_HZ, SAMPLE_RATE_HZ, SAMPLES, bench_recording


@pytest.mark.slow
def test_an_external_stiffness_modulation_is_unknown_in_the_mechanics() -> None:
    """No term of the catalogue modulates the stiffness. A drifting clock of the sense channel fits almost as well."""
    diagnosis = diagnose([bench_recording(stiffness_modulation=0.01, seed=6)])
    assert [(finding.effect, finding.stage) for finding in diagnosis.findings] == [("unknown", "mechanics")]
    scatter = np.sqrt(2.0 / diagnosis.search.final.validation_rows.sum())
    assert diagnosis.search.final.validation_chi2 < 1.0 + 3.0 * scatter < 2.0 < diagnosis.search.nominal.validation_chi2
    curve = diagnosis.findings[0].curve
    assert curve is not None
    assert (curve["x"], curve["y"]) == ("time (s)", "stiffness error / k")
    assert "= 0.01 x cos(12 π t/T) with" in curve["formula"]
    time, value, sd = np.array(curve["points"]).T
    assert np.all(np.abs(value - 0.01 * np.cos(2 * np.pi * 6 * time * SAMPLE_RATE_HZ / SAMPLES)) < 4.0 * sd + 1e-4)


@pytest.mark.slow
def test_a_delay_that_grows_with_the_amplitude_is_unknown_in_the_timing() -> None:
    """No term of the catalogue has such a delay. Three terms of the mechanics together fit almost as well."""
    diagnosis = diagnose([bench_recording(delay=2e-6, seed=6)])
    assert [(finding.effect, finding.stage) for finding in diagnosis.findings] == [("unknown", "timing")]
    curve = diagnosis.findings[0].curve
    assert curve is not None
    assert (curve["x"], curve["y"]) == ("amplitude (rad)", "delay")
    swing, delay, sd = np.array(curve["points"]).T
    assert (np.abs(delay - 2e-6 * (swing / 1e-3) ** 2) < 4.0 * sd + 1e-9).all()
    assert sd[-1] < 0.1 * delay[-1]


@pytest.mark.slow
def test_a_delay_that_lags_behind_the_amplitude_is_unknown_in_the_timing() -> None:
    """With a delay of the present amplitude alone, a free torque over the state of the motion would fit better."""
    diagnosis = diagnose([bench_recording(delay=1e-5, delay_time_constant=4 / RESONANCE_HZ, seed=6)])
    assert [(finding.effect, finding.stage) for finding in diagnosis.findings] == [("unknown", "timing")]
    scatter = np.sqrt(2.0 / diagnosis.search.final.validation_rows.sum())
    assert diagnosis.search.final.validation_chi2 < 1.0 + 3.0 * scatter < 2.0 < diagnosis.search.nominal.validation_chi2
    curve = diagnosis.findings[0].curve
    assert curve is not None
    assert "M_4" in curve["formula"].split(" with ")[0]


@pytest.mark.slow
def test_backlash_of_the_readout_is_unknown_in_the_readout() -> None:
    """Its lag depends on the angle, not on time or rate. The closest other term is a free torque over the state."""
    diagnosis = diagnose([bench_recording(backlash=3e-4, seed=6)])
    assert [(finding.effect, finding.stage) for finding in diagnosis.findings] == [("unknown", "readout")]
    curve = diagnosis.findings[0].curve
    assert curve is not None
    assert (curve["x"], curve["y"]) == ("phase of the oscillation (rad)", "signal error / rms")
    assert "P_0" in curve["formula"]


def replace_named_terms(run: Recording, *names: str, turns: int = 8) -> tuple[SelectionState, Fit]:
    """The state of a search that replaced named terms by free ones where these explain more, and the named fit."""
    prepared = prepare_run(run, DEVICE)
    nominal = Model([prepared], DEVICE)
    likelihood = Likelihood([prepared], flat_whiteners(nominal))
    stops = window_schedule(nominal)
    early = fit_progressively(likelihood, nominal, fit_initial_state(likelihood, nominal, stops[0]).x, stops)[-1]
    model = Model([prepared], DEVICE, [Candidate(catalogue()[name], "x", "sense") for name in names], nominal.mains)
    named = fit_model(likelihood, model, model.map_parameters_from(early.model, early.x), max_iterations=turns)
    return _replace_terms_by_discrepancy(SelectionState(likelihood, early, named, {})), named


@pytest.mark.slow
def test_three_polynomial_terms_are_replaced_by_one_free_torque() -> None:
    """A stop on one side is no polynomial of the angle. Three powers approximate it; one free torque describes it."""
    powers = [f"{name}-stiffness" for name in ("quadratic", "cubic", "quintic")]
    state, named = replace_named_terms(bench_recording(stop_stiffness=0.2, seed=6), *powers, turns=20)
    assert [candidate.term.effect for candidate in state.best.model.candidates] == ["free-mechanics"]
    assert [lead.candidate.term.effect for lead in state.rivals["x.free-mechanics"]] == powers
    assert state.best.validation_chi2 < named.validation_chi2


@pytest.mark.slow
def test_two_timing_terms_are_replaced_by_one_pruned_free_delay() -> None:
    state, named = replace_named_terms(bench_recording(delay=2e-6, seed=6), "channel-delay", "clock-skew")
    (candidate,) = state.best.model.candidates
    assert candidate.term.effect == "free-timing"
    assert "r2" in {parameter.name for parameter in candidate.term.free_parameters}
    assert len(candidate.term.free_parameters) < 5 < len(DISCREPANCY_TERMS["free-timing"].free_parameters)
    assert state.best.validation_chi2 < named.validation_chi2
