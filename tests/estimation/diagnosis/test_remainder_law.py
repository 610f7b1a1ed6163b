"""The law of what named laws leave: measured beside them, and a part of the improved device."""

from __future__ import annotations

import pytest

from estimation.candidate_terms.discrepancy import DISCREPANCY_TERMS
from estimation.device_fit.data import prepare_run
from estimation.device_fit.fit import linearise_at
from estimation.device_fit.open_loop import open_loop
from estimation.device_fit.parameters import Candidate
from estimation.diagnosis.improvement import Improvement, improved_device
from estimation.diagnosis.remainder_law import with_remainder_law
from estimation.diagnosis.selection import SelectionResult
from scanner.device import Device
from tests.support.bench import DEVICE, bench_recording
from tests.support.cubic_spring import K3, LARGEST_ANGLE, fit_cubic_stiffness

CORRECTIONS = {effect: Candidate(term, "x", "sense") for effect, term in DISCREPANCY_TERMS.items()}


def improved_by_cubic_stiffness(**imperfection: float) -> Improvement:
    """The improvement of the bench by its cubic stiffness alone, from a recording with an imperfection."""
    likelihood, fit = fit_cubic_stiffness(bench_recording(k3=K3, seed=4, **imperfection))
    nominal = fit.model.with_candidates([])
    base = linearise_at(likelihood, nominal, nominal.map_parameters_from(fit.model, fit.x))
    device, runs = improved_device(fit), likelihood.runs
    return Improvement(SelectionResult(likelihood, base, fit), device, open_loop(runs, DEVICE), open_loop(runs, device))


def unused_error(device: Device, **imperfection: float) -> float:
    """Open-loop error [V] in a recording that no fit used."""
    run = prepare_run(bench_recording(k3=K3, seed=5, **imperfection), DEVICE)
    return open_loop([run], device)["sense_x"].error


@pytest.mark.slow
def test_a_dead_zone_beside_a_cubic_spring_is_a_part_of_the_device() -> None:
    dead_zone = 0.02 * LARGEST_ANGLE
    alone = improved_by_cubic_stiffness(dead_zone=dead_zone)
    both = with_remainder_law(alone, CORRECTIONS["free-readout"])
    terms = both.device.axis("x").terms
    assert both.remainder_fit is not None
    assert both.remainder_fit.validation_chi2 < alone.search.final.validation_chi2
    assert terms["cubic-stiffness"] == alone.device.axis("x").terms["cubic-stiffness"]
    assert terms["measured-law"]["stage"] == "readout"
    assert both.improved["sense_x"].error < alone.improved["sense_x"].error
    noise_alone = DEVICE.axis("x").readout.noise_sd  # type: ignore[union-attr]
    assert unused_error(both.device, dead_zone=dead_zone) < 1.03 * noise_alone
    assert unused_error(alone.device, dead_zone=dead_zone) > 1.06 * noise_alone


@pytest.mark.slow
@pytest.mark.parametrize("effect", ["free-mechanics", "free-readout", "free-drive", "free-timing"])
def test_a_complete_device_gets_no_measured_law(effect: str) -> None:
    alone = improved_by_cubic_stiffness()
    assert with_remainder_law(alone, CORRECTIONS[effect]) is alone
