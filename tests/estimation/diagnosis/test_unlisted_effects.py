"""An effect that is not in the catalogue is reported as unknown, with its stage and its measured curve."""

from __future__ import annotations

import numpy as np
import pytest

from estimation.candidate_terms.discrepancy import DISCREPANCY_TERMS
from estimation.diagnosis.diagnose import Diagnosis, diagnose
from scanner.terms.measured_law import added, measured_law
from tests.support.bench import RESONANCE_HZ, SAMPLE_RATE_HZ, SAMPLES, bench_recording
from tests.support.cubic_spring import LARGEST_ANGLE


def _free_parameters(diagnosis: Diagnosis) -> set[str]:
    """Names of the amplitudes of the discrepancy term that the recording requires."""
    (candidate,) = diagnosis.search.final.model.candidates
    return {parameter.name for parameter in candidate.term.free_parameters}


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
    assert "k12" in _free_parameters(diagnosis)
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
    assert "m1" in _free_parameters(diagnosis)  # the memory of four periods


@pytest.mark.slow
def test_backlash_of_the_readout_is_unknown_in_the_readout() -> None:
    """Its lag depends on the angle, not on time or rate. The closest other term is a free torque over the state."""
    diagnosis = diagnose([bench_recording(backlash=3e-4, seed=6)])
    assert [(finding.effect, finding.stage) for finding in diagnosis.findings] == [("unknown", "readout")]
    curve = diagnosis.findings[0].curve
    assert curve is not None
    assert (curve["x"], curve["y"]) == ("phase of the oscillation (rad)", "signal error / rms")
    assert {"m0", "m1", "m2"} & _free_parameters(diagnosis)  # play operators


@pytest.mark.slow
def test_a_stop_on_one_side_is_unknown_in_the_mechanics() -> None:
    """A stop on one side is no polynomial of the angle. Three powers approximate it; one free torque describes it."""
    diagnosis = diagnose([bench_recording(stop_stiffness=0.2, seed=6)])
    assert [(finding.effect, finding.stage) for finding in diagnosis.findings] == [("unknown", "mechanics")]
    (candidate,) = diagnosis.search.final.model.candidates
    assert len(_free_parameters(diagnosis)) < len(DISCREPANCY_TERMS[candidate.term.effect].free_parameters)


@pytest.mark.slow
def test_a_law_that_takes_a_quarter_of_a_misfit_is_no_answer() -> None:
    """Beside a narrow dead zone, a cubic curve explains more than any other law, and corrections beside it the rest."""
    diagnosis = diagnose([bench_recording(dead_zone=0.05 * LARGEST_ANGLE, seed=3)])
    assert [(finding.effect, finding.stage) for finding in diagnosis.findings] == [("unknown", "readout")]
    assert diagnosis.findings[0].share > 0.5


@pytest.mark.slow
def test_a_dead_zone_is_unknown_in_the_readout_and_the_device_has_its_kinks() -> None:
    """A polynomial does not follow it. With other nominal values a second mode explains a part of it."""
    half_width = 3e-4
    diagnosis = diagnose([bench_recording(dead_zone=half_width, seed=6)])
    assert [(finding.effect, finding.stage) for finding in diagnosis.findings] == [("unknown", "readout")]
    law = diagnosis.device.axis("x").terms["measured-law"]
    _, packed = measured_law(law)
    signal = np.linspace(law["lower"][0], law["upper"][0], 201)
    shown = signal + added(signal, packed)
    steep = np.abs(signal) > 2.0 * 20.0 * half_width
    flat = np.abs(signal) < 0.5 * 20.0 * half_width
    slope = np.gradient(shown, signal)
    assert np.abs(slope[flat]).max() < 0.6 < slope[steep].min()
